"""Recorded turbulence: pieces of the displacement fields of real footage, other in place and time
for every view, move the frames, and a constant Gaussian blur goes with them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from kornia.filters import gaussian_blur2d
from torch import Generator, Tensor

from src.sim import noise
from src.sim.optics import Position, view_id
from src.sim.turbulence.clip_rendering import run_in_threads
from src.sim.turbulence.contract import Crop, Frames, Tilt, Views, check_option
from src.sim.turbulence.engines.device import select_blur_engine
from src.sim.turbulence.engines.warp_numba import pad_frames, warp_frames
from src.sim.turbulence.footage_displacement import UnitRmsDisplacement, track_displacement_fields

PLACES, TIMES = 2, 3  # pieces of the footage: PLACES x PLACES in the picture, TIMES in time
LARGEST_TILT_PX = 8.0  # rms


class RecordedTurbulence:
    """A turbulence model (contract.py) that moves frames as turbulence in real footage did.

    `footage`: a video or a folder of frames of a still scene through turbulence, its smaller side
    taken for 256 pixels.  `tilt_rms_px`: names of strengths with the tilt's rms along an axis;
    `severity`: one of the names, or `mixed`: each as often.  `footage_fps`: what the footage is
    taken for.  `blur_over_tilt`: standard deviation of a Gaussian, in units of the rms tilt.
    Raises ValueError for footage that is missing, too short, or moves, and for values outside
    their range.
    """

    def __init__(
        self,
        footage: str | None,
        *,
        tilt_rms_px: Mapping[str, float],
        severity: str = "mixed",
        footage_fps: float = 30.0,
        blur_over_tilt: float = 0.4,
    ):
        for name, rms in tilt_rms_px.items():
            allowed = f"in [0, {LARGEST_TILT_PX:g}] pixels"
            check_option(0 <= rms <= LARGEST_TILT_PX, f"tilt_rms_px.{name}", allowed, rms)
        names = ["mixed", *tilt_rms_px]
        check_option(severity in names, "severity", ", ".join(names), severity)
        check_option(0 < footage_fps < math.inf, "footage_fps", "> 0", footage_fps)
        valid = 0 <= blur_over_tilt <= 2
        check_option(valid, "blur_over_tilt", "in [0, 2] times the tilt", blur_over_tilt)
        is_there = bool(footage) and Path(str(footage)).exists()
        expected = "a video or folder of frames of a still scene through turbulence"
        check_option(is_there, "footage", expected, footage)
        self.names = list(tilt_rms_px) if severity == "mixed" else [severity]
        self.tilt_rms_px, self.footage_fps = dict(tilt_rms_px), footage_fps
        self.blur_over_tilt = blur_over_tilt
        self.fields = track_displacement_fields(Path(str(footage)).resolve())

    def draw(self, generator: Generator) -> str:
        """Draw the name of a strength."""
        return self.names[int(torch.randint(len(self.names), (), generator=generator))]

    def operator(
        self, drawn: str, *, views: Sequence[Position], height: int, width: int, fps: float
    ) -> "RecordedTurbulenceOperator":
        if len(set(map(_place_in_block, views))) < len(views):
            raise ValueError(
                f"optics must have at most nine views, within 3x3, for turbulence=recorded: each "
                f"has a piece of the footage of its own; got {len(views)} views"
            )
        rms, size, step = self.tilt_rms_px[drawn], (height, width), self.footage_fps / fps
        blur_px = self.blur_over_tilt * rms
        return RecordedTurbulenceOperator(self.fields, drawn, rms, views, size, step, blur_px)


@dataclass(frozen=True)
class RecordedTurbulenceOperator:
    """The operator of a clip (contract.py): every view has a piece of the footage of its own.

    `tilt_rms_px`: along an axis; `size` (h, w) of frames; `step`: footage frames per frame;
    `blur_px`: standard deviation.
    """

    fields: UnitRmsDisplacement
    severity: str
    tilt_rms_px: float
    views: Sequence[Position]
    size: tuple[int, int]
    step: float
    blur_px: float

    @property
    def metadata(self) -> dict[str, float | str]:
        tilt, blur = self.tilt_rms_px, self.blur_px
        return {"severity": self.severity, "tilt_px": tilt, "blur_px": blur}

    @torch.no_grad()
    def degrade(self, frames: Frames, generator: Generator, *, crop: Crop | None = None) -> Views:
        """Return what every view sees: moved, then blurred."""
        reach, (top, left, height, width) = math.ceil(3 * self.blur_px), crop or (0, 0, *self.size)
        window = (top - reach, left - reach, height + 2 * reach, width + 2 * reach)
        seen = []
        for clip in frames.float():
            tilt = self.tilt(len(clip), generator, crop=window).transpose(1, 2).contiguous()
            views = _warp_views(clip, tilt.to(clip.device), *window[:2])
            if reach:
                size, sigma = (2 * reach + 1,) * 2, (self.blur_px,) * 2
                views = gaussian_blur2d(views, size, sigma, "constant")
            seen.append(views[..., reach : reach + height, reach : reach + width])
        return torch.stack(seen)

    def tilt(self, frames: int, generator: Generator, *, crop: Crop | None = None) -> Tilt:
        """Return the displacement of `degrade`; `crop` may reach beyond the frame."""
        key = noise.draw_base_key(generator)
        pieces = noise.uniform(noise.key(key, "pieces"), torch.arange(PLACES**2 * TIMES))
        order, window = pieces.argsort().tolist(), crop or (0, 0, *self.size)
        return torch.stack([self._view(one, frames, order, key, window) for one in self.views])

    def _view(
        self, position: Position, frames: int, order: list[int], key: int, window: Crop
    ) -> Float[Tensor, "frames xy=2 h w"]:
        """Return what one view's piece does, mirrored, turned and played as drawn for this view;
        views of a 3x3 block have different pieces, which are shuffled into `order`.
        """
        stretch, place = divmod(order[_place_in_block(position)], PLACES**2)
        drawn = noise.uniform(noise.key(key, view_id(position), "piece"), torch.arange(5)).tolist()
        across, down, turned, back = (u < 0.5 for u in drawn[:4])
        sign = (-1.0 if across else 1.0, -1.0 if down else 1.0)
        top, left, height, width = window
        x = sign[0] * (np.arange(width) + left - (self.size[1] - 1) / 2)
        y = sign[1] * (np.arange(height) + top - (self.size[0] - 1) / 2)
        right = (place % PLACES + 0.5) / PLACES * self.fields.width_px
        below = (place // PLACES + 0.5) / PLACES * self.fields.height_px
        length, passed = len(self.fields.nodes) / TIMES, np.arange(frames) * self.step
        start = stretch * length + drawn[4] * max(length - 1 - passed[-1], 0)
        time = start + (passed[::-1] if back else passed)  # within the stretch, if it fits
        if turned:
            moved = self.fields.sample(time, below + x, right + y).transpose(-1, -2).flip(1)
        else:
            moved = self.fields.sample(time, below + y, right + x)
        return self.tilt_rms_px * torch.tensor(sign)[:, None, None] * moved


def _place_in_block(position: Position) -> int:
    """Return which of nine a view is in blocks of 3x3."""
    row, col = position
    return 3 * (row % 3) + col % 3


def _warp_views(
    frames: Float[Tensor, "frames height width"],
    tilt: Float[Tensor, "views xy=2 frames h w"],
    top: int,
    left: int,
) -> Float[Tensor, "views frames h w"]:
    """Return the frames from (top, left) on, perhaps outside, displaced as in every view."""
    if frames.device.type != "cpu":
        warp_cubic = select_blur_engine(frames.device).warp_cubic
        return torch.stack([warp_cubic(frames, view, top, left) for view in tilt])
    padded, out = pad_frames(frames), torch.empty(len(tilt), *tilt.shape[2:])

    def warp_view(view: int) -> None:
        for frame, warped in enumerate(warp_frames(padded, 0, tilt[view], top, left)):
            out[view, frame] = torch.from_numpy(warped)

    run_in_threads(warp_view, [(view,) for view in range(len(tilt))])
    return out
