"""Turbulence that was seen: the tilt of real footage instead of simulated air's.

Pieces of the footage's displacement fields (fields.py), other in place and time for every view,
move the frames, and a constant blur goes with them.  Nothing of the simulated air is used.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.optics import Position, view_id
from src.sim.turbulence import blur
from src.sim.turbulence.fields import Fields, fields
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.model import Crop
from src.sim.turbulence.ranges import require
from src.sim.turbulence.threads import in_threads

PLACES, STRETCHES = 2, 3  # pieces of the footage: PLACES x PLACES in the picture, STRETCHES in time
FAR = 4096  # pixels between the nodes of a blur that is the same everywhere
MOST_PX = 8.0  # of rms tilt


@dataclass(frozen=True)
class Strength:
    """What is drawn for a clip: the name of a strength and the tilt's rms along an axis, pixels."""

    severity: str
    rms_px: float


class RecordedTilt:
    """A turbulence model (model.py) that moves frames as the air in real footage did.

    `root`: a video or a folder of frames of a still scene through air, its smaller side taken for
    256 pixels.  `rms_px`: names of strengths with the tilt's rms along an axis in pixels;
    `severity`: one of the names, or `mixed`: each as often.  `rate`: frames per second that the
    footage is taken for.  `blur`: standard deviation of a Gaussian, in units of the rms tilt.
    Raises ValueError for footage that is missing, too short, or moves, and for values outside
    their range.
    """

    def __init__(
        self,
        root: str | None,
        *,
        rms_px: Mapping[str, float],
        severity: str = "mixed",
        rate: float = 30.0,
        blur: float = 0.4,
    ):
        for name, rms in rms_px.items():
            require(0 <= rms <= MOST_PX, f"rms_px.{name}", f"in [0, {MOST_PX:g}] pixels", rms)
        valid = severity in ("mixed", *rms_px)
        require(valid, "severity", ", ".join(["mixed", *rms_px]), severity)
        require(0 < rate < math.inf, "rate", "> 0 frames per second", rate)
        require(0 <= blur <= 2, "blur", "in [0, 2] times the tilt", blur)
        there = root is not None and Path(root).exists()
        require(there, "root", "a video or folder of frames of a still scene through air", root)
        self.names = list(rms_px) if severity == "mixed" else [severity]
        self.rms_px, self.rate, self.blur = dict(rms_px), rate, blur
        self.fields = fields(Path(root).resolve())

    def draw(self, generator: torch.Generator) -> Strength:
        """Draw the strength of a clip."""
        name = self.names[int(torch.randint(len(self.names), (), generator=generator))]
        return Strength(name, self.rms_px[name])

    def operator(
        self, drawn: Strength, *, views: Sequence[Position], height: int, width: int, fps: float
    ) -> "RecordedAir":
        """Return the air of a clip."""
        step, blur_px = self.rate / fps, self.blur * drawn.rms_px
        return RecordedAir(self.fields, drawn, views, (height, width), step, blur_px)


@dataclass(frozen=True)
class RecordedAir:
    """One clip's air (model.py): every view looks through a piece of the footage of its own.

    `size` (h, w) of the frames; `step`: frames of the footage from one frame to the next;
    `blur_px`: standard deviation of the blur.
    """

    fields: Fields
    drawn: Strength
    views: Sequence[Position]
    size: tuple[int, int]
    step: float
    blur_px: float

    @property
    def facts(self) -> dict[str, float | str]:
        """What is recorded about the clip."""
        tilt = self.drawn.rms_px
        return {"severity": self.drawn.severity, "tilt_px": tilt, "blur_px": self.blur_px}

    @torch.no_grad()
    def degrade(
        self,
        frames: Float[Tensor, "n frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "n views frames hc wc"]:
        """Return what every view sees, linear light: moved, then blurred."""
        count, device = frames.shape[1], frames.device
        kernel = _gaussian(self.blur_px).to(device)
        reach = len(kernel) // 2
        top, left, height, width = crop or (0, 0, *self.size)
        window = (top - reach, left - reach, height + 2 * reach, width + 2 * reach)
        rows, columns = (Lattice(window[k], window[k + 2], FAR, 1) for k in (0, 1))
        nodes = (count, len(rows.pixels), len(columns.pixels))
        psfs = kernel.flatten()[:, None, None, None].expand(-1, *nodes).contiguous()
        around = (rows, columns, torch.zeros(count, height, width, device=device), 0.0)
        out = torch.empty(len(frames), len(self.views), count, height, width, device=device)
        for seen, clip in zip(out, frames.float(), strict=True):
            tilt = self.tilt(count, generator, crop=window).transpose(1, 2).to(device).contiguous()
            if device.type == "cpu":
                given = (psfs, len(kernel), None, *around)
                _view_by_view(seen, blur.pictures(clip), tilt, given)
                continue
            lines = psfs @ columns.weights().T.to(device)
            for view, moved in zip(seen, tilt, strict=True):  # a few launches each
                view.copy_(blur.at_once(clip, moved, lines, *around))
        return out

    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 h w"]:
        """Return the displacement (x, y) in pixels that `degrade` gives its first clip.

        `crop` may reach beyond the frame.
        """
        key = noise.base_key(generator)
        pieces = noise.uniform(noise.key(key, "pieces"), torch.arange(PLACES**2 * STRETCHES))
        order, window = pieces.argsort().tolist(), crop or (0, 0, *self.size)
        views = [self._view(position, frames, order, key, window) for position in self.views]
        return torch.stack(views)

    def _view(
        self, position: Position, frames: int, order: list[int], key: int, window: Crop
    ) -> Float[Tensor, "frames 2 h w"]:
        """Return what one view's piece does: mirrored, turned and played in a direction that are
        drawn for this view alone.

        Views of a 3x3 block have different pieces, which are shuffled into `order` for each clip.
        """
        row, col = position
        stretch, place = divmod(order[3 * (row % 3) + col % 3], PLACES**2)
        drawn = noise.uniform(noise.key(key, view_id(position), "piece"), torch.arange(5)).tolist()
        across, down, turned, back = (u < 0.5 for u in drawn[:4])
        sign = (-1.0 if across else 1.0, -1.0 if down else 1.0)
        top, left, height, width = window
        x = sign[0] * (np.arange(width) + left - (self.size[1] - 1) / 2)
        y = sign[1] * (np.arange(height) + top - (self.size[0] - 1) / 2)
        right = (place % PLACES + 0.5) / PLACES * self.fields.width_px
        below = (place // PLACES + 0.5) / PLACES * self.fields.height_px
        time = self._times(frames, stretch, drawn[4], back)
        if turned:
            moved = self.fields.at(time, below + x, right + y).transpose(-1, -2).flip(1)
        else:
            moved = self.fields.at(time, below + y, right + x)
        return self.drawn.rms_px * torch.tensor(sign)[:, None, None] * moved

    def _times(self, frames: int, stretch: int, late: float, back: bool) -> NDArray:
        """Return when the frames are, in frames of the footage: within the stretch, if they fit."""
        length = len(self.fields.nodes) / STRETCHES
        passed = np.arange(frames) * self.step
        start = stretch * length + late * max(length - 1 - passed[-1], 0)
        return start + (passed[::-1] if back else passed)


def _view_by_view(out: Tensor, shown: blur.Pictures, tilt: Tensor, given: tuple) -> None:
    """Write what the views see to `out`; `given`: the PSFs, as `blur.degrade` has them."""

    def one(view: Tensor, moved: Tensor) -> None:
        view.copy_(blur.degrade(shown, 0, moved, *given))

    in_threads(one, zip(out, tilt, strict=True))


def _gaussian(deviation: float) -> Float[Tensor, "k k"]:
    """Return a Gaussian out to three standard deviations, its sum 1."""
    reach = math.ceil(3 * deviation)
    away = torch.arange(-reach, reach + 1) / max(deviation, 1e-6)
    line = torch.exp(-0.5 * away**2)
    return line[:, None] * line / line.sum() ** 2
