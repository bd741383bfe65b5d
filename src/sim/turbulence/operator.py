"""Turbulence as an operator: clean frames in, what every view sees out; tilt first, then blur."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from itertools import product

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import layout
from src.sim.turbulence import blur, whole_clip
from src.sim.turbulence.ahead import AirAhead
from src.sim.turbulence.amplitudes import Motion
from src.sim.turbulence.atmosphere import ALPHA_FPS, Atmosphere
from src.sim.turbulence.fidelity import Fidelity, choose, mean_psf
from src.sim.turbulence.halo import Halo
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.model import Crop
from src.sim.turbulence.p2s import Spots, band_for
from src.sim.turbulence.phase import Waves, draw_waves
from src.sim.turbulence.psf import exact_spots
from src.sim.turbulence.ranges import require
from src.sim.turbulence.threads import in_threads
from src.sim.turbulence.wave_field import Field

WAVES = 384
TILE = 320  # pixels; larger pictures are made tile by tile, to bound the memory
CHUNK = 2_000_000  # numbers at the nodes of a view at a time, on the CPU


class Turbulence:
    """The atmosphere between a scene and the views of a light field.

    `views`: how many (see `optics.layout`) or a list of (row, col); frames are `height` x `width`
    pixels at `fps`.  `tolerance` in (0, 1]: the error allowed, as a share of the power by which the
    turbulence blurs a picture at random (fidelity.py).  `modes`: how many Noll modes from
    tilt on, 2 to 200, no more than a fitted network knows; None: as the tolerance asks.  `psf`:
    `fitted` (basis and network) or `exact` (Fraunhofer at every node).  `temporal`: `ar1` (the
    paper: alpha per frame at 120 fps), `flow`, frozen turbulence in `wind_layers` layers each
    carried by a wind of its own, about `wind_m_s` (None: the atmosphere's), or `mixed`, one of the
    two drawn per clip.
    `views_correlation`: `independent` (the paper) or `baseline`, sub-apertures `baseline_m` apart
    (None: touching) looking through the same air.  `atmosphere` None is the identity.
    Raises ValueError for values outside their range.
    """

    def __init__(
        self,
        atmosphere: Atmosphere | None,
        *,
        views: int | Sequence[Sequence[int]],
        height: int,
        width: int,
        fps: float = 120.0,
        tolerance: float = 0.26,
        modes: int | None = None,
        psf: str = "fitted",
        temporal: str = "ar1",
        wind_m_s: float | None = None,
        wind_layers: int = 4,
        views_correlation: str = "independent",
        baseline_m: float | None = None,
    ):
        require(height >= 1 and width >= 1, "frame", "at least 1 x 1", (height, width))
        require(0 < fps < math.inf, "fps", "> 0", fps)
        require(0 < tolerance <= 1, "tolerance", "in (0, 1]", tolerance)
        require(psf in ("fitted", "exact"), "psf", "fitted or exact", psf)
        self.motion = Motion(temporal, wind_m_s, wind_layers, views_correlation, baseline_m)
        self.atmosphere, self.height, self.width, self.fps = atmosphere, height, width, fps
        self.positions = layout(views) if isinstance(views, int) else tuple(map(tuple, views))
        self.clear = atmosphere is None or atmosphere.d_over_r0 == 0
        self.fidelity, self.spots, self.halo = Fidelity(), None, None
        if not self.clear:
            chosen = choose(atmosphere, width, tolerance, psf == "exact", modes)
            strength, airy, kernel = chosen.blurring_d_over_r0, chosen.airy_px, chosen.kernel
            if chosen.rank:
                numbers = chosen.network, chosen.rank, airy, kernel
                self.spots = Spots(band_for(strength), *numbers, strength)
            self.fidelity, self.halo = chosen, Halo(mean_psf(strength), airy, kernel)

    @property
    def facts(self) -> dict[str, float | int | str]:
        """What is recorded about the clip: its `fidelity`."""
        return asdict(self.fidelity)

    @torch.no_grad()
    def degrade(
        self,
        frames: Float[Tensor, "n frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "n views frames hc wc"]:
        """Return what every view sees, linear light in and out.

        Only `crop` (top, left, height, width) is simulated; it equals that part of the whole.
        """
        window = self._window(frames, crop)
        if self.clear:
            top, left, height, width = window
            part = frames[:, None, :, top : top + height, left : left + width]
            return part.expand(-1, len(self.positions), -1, -1, -1)
        seen = []
        for clip in frames.float():
            waves, moving = self._draw(generator, len(clip), clip.device)
            if clip.device.type == "cpu":
                seen.append(self._view_by_view(clip, waves, moving, window))
            else:
                seen.append(whole_clip.degrade(clip, self._plans(waves, moving, window)))
        return seen[0][None] if len(seen) == 1 else torch.stack(seen)

    def ahead(self, frames: int, generator: torch.Generator, crop: Crop) -> "Turbulence | AirAhead":
        """Return the air of one clip of so many frames, drawn and prepared for `crop` on the CPU:
        small, to be sent to where a device computes the pixels.
        """
        if self.clear:
            return self
        waves, moving = self._draw(generator, frames)
        return AirAhead(self.facts, crop, self._plans(waves, moving, crop))

    @torch.no_grad()
    def tilt(
        self, frames: int, generator: torch.Generator, *, crop: Crop | None = None
    ) -> Float[Tensor, "views frames 2 h w"]:
        """Return the displacement (x, y) in pixels that `degrade` gives its first clip.

        For a generator in the same state, and that many frames.
        """
        window = crop or (0, 0, self.height, self.width)
        if self.clear:
            return torch.zeros(len(self.positions), frames, 2, *window[2:])
        waves, moving = self._draw(generator, frames)
        field = self._field(waves, slice(0, 2), window)
        return self._tilt_px * torch.stack([field.at_pixels(c).transpose(0, 1) for c in moving])

    def _view_by_view(
        self, frames: Tensor, waves: Waves, moving: Tensor, window: Crop
    ) -> Float[Tensor, "views frames h w"]:
        """Return what every view sees in `window`, on the CPU."""
        out, shown = torch.empty(*moving.shape[:2], *window[2:]), blur.pictures(frames)
        for tile in _tiles(window):
            y, x = tile[0] - window[0], tile[1] - window[1]
            part = out[..., y : y + tile[2], x : x + tile[3]]
            self._tile(frames, shown, waves, moving, tile, part)
        return out

    def _tile(
        self,
        frames: Tensor,
        shown: blur.Pictures,
        waves: Waves,
        moving: Tensor,
        tile: Crop,
        out: Tensor,
    ) -> None:
        """Write what every view sees in `tile` to `out` (views, frames, h, w).

        A view's phase is computed apart, so that its numbers do not depend on its company.
        """
        halo, window = self.halo(frames, *tile), self._sources(tile)
        tilt = self._field(waves, slice(0, 2), window)
        rest = self._field(waves, slice(2, None), window)
        lattices = self._lattices(window, self.fidelity.pitch, 1)
        lines = self.fidelity.rank or self.fidelity.kernel**2
        step = max(1, CHUNK // (max(2, lines) * window[2] * window[3]))

        def one(view: int, first: int) -> None:
            part = slice(first, first + step)
            amplitudes = moving[view, part]
            moved = tilt.at_pixels(amplitudes).mul_(self._tilt_px)
            nodes = self._nodes(rest.at_nodes(amplitudes))
            around = (self.fidelity.kernel, self.spots, *lattices, halo[part], self.halo.share)
            out[view, part] = blur.degrade(shown, first, moved, nodes, *around)

        in_threads(one, product(range(len(moving)), range(0, len(frames), step)))

    def _plans(self, waves: Waves, moving: Tensor, window: Crop) -> list[whole_clip.Plan]:
        """Return what a device needs of the clip in `window`, tile by tile."""
        known = {"spots": self.spots, "halo": self.halo, "tilt_px": self._tilt_px}
        known |= {"fidelity": self.fidelity, "frame": (self.height, self.width)}
        plans = []
        for tile in _tiles(window):
            sources = self._sources(tile)
            tilt = self._lattices(sources, self.fidelity.tilt_pitch, 3)
            rest = self._lattices(sources, self.fidelity.pitch, 1)
            plans.append(whole_clip.plan(tile, moving, waves, tilt=tilt, rest=rest, **known))
        return plans

    def _nodes(
        self, phase: Float[Tensor, "blurmodes frames rows columns"]
    ) -> Float[Tensor, "numbers frames rows columns"]:
        """Return what the PSFs are at the nodes: weights of the basis, or their very pixels."""
        if self.spots is not None:
            return self.spots(phase)
        return exact_spots(phase, self.fidelity.airy_px, self.fidelity.kernel)

    def _field(self, waves: Waves, modes: slice, window: Crop) -> Field:
        """Prepare tilt (modes 0, 1) or the modes that blur on the lattice meant for them."""
        is_tilt = modes.start == 0
        pitch = self.fidelity.tilt_pitch if is_tilt else self.fidelity.pitch
        lattices = self._lattices(window, pitch, 3 if is_tilt else 1)
        return Field(waves, modes, *lattices, (self.height, self.width))

    @property
    def _tilt_px(self) -> float:
        """Pixels a radian of Noll's a2: (2 / pi) lambda f / (D p)."""
        return 2 / math.pi * self.fidelity.airy_px

    def _draw(
        self, generator: torch.Generator, frames: int, device: torch.device | str = "cpu"
    ) -> tuple[Waves, Complex[Tensor, "views frames waves"]]:
        """Draw one clip's waves, and on `device` their amplitudes in every view and frame."""
        key = noise.base_key(generator)
        waves = draw_waves(
            self.atmosphere,
            noise.key(key, "waves"),
            modes=self.fidelity.modes,
            waves=WAVES,
            width_px=self.width,
        )
        alpha = self.atmosphere.alpha ** (ALPHA_FPS / self.fps)
        clip = {"positions": self.positions, "frames": frames, "fps": self.fps, "device": device}
        return waves, self.motion.amplitudes(self.atmosphere, waves, key, alpha=alpha, **clip)

    def _sources(self, tile: Crop) -> Crop:
        """Return the pixels whose light reaches a tile."""
        reach = self.fidelity.kernel // 2
        top, left, height, width = tile
        return top - reach, left - reach, height + 2 * reach, width + 2 * reach

    def _lattices(self, window: Crop, pitch: int, order: int) -> tuple[Lattice, Lattice]:
        top, left, height, width = window
        return Lattice(top, height, pitch, order), Lattice(left, width, pitch, order)

    def _window(self, frames: Tensor, crop: Crop | None) -> Crop:
        size = (self.height, self.width)
        require(tuple(frames.shape[-2:]) == size, "frame", f"{size}", tuple(frames.shape[-2:]))
        top, left, height, width = crop or (0, 0, *size)
        inside = 0 <= top <= top + height <= size[0] and 0 <= left <= left + width <= size[1]
        require(inside and height > 0 and width > 0, "crop", f"inside the {size} frame", crop)
        return top, left, height, width


def _tiles(window: Crop) -> Iterator[Crop]:
    top, left, height, width = window
    for y in range(0, height, TILE):
        for x in range(0, width, TILE):
            yield top + y, left + x, min(TILE, height - y), min(TILE, width - x)
