"""Turbulence as an operator: clean frames in, what every view sees out; tilt first, then blur."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from src.sim import noise
from src.sim.optics import layout
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.clip_plan import TilePlan, plan_tile
from src.sim.turbulence.clip_rendering import render_tilt, render_views
from src.sim.turbulence.contract import Crop, Frames, Tilt, Views, check_option
from src.sim.turbulence.fidelity import Fidelity, choose_fidelity, mean_short_exposure_psf
from src.sim.turbulence.p2s import FittedPSFs, find_psf_band
from src.sim.turbulence.plane_waves import WaveDynamics, draw_plane_waves
from src.sim.turbulence.psf import PSFHalo
from src.sim.turbulence.unresolved_blur import missing_structure_function

WAVES = 384
TILE = 320  # pixels; larger frames are made tile by tile, to bound the memory


class Turbulence:
    """The atmosphere between a scene and the views of a light field.

    `views`: how many (see `optics.layout`) or a list of (row, col); frames are `height` x `width`
    pixels at `fps`.  `tolerance` in (0, 1]: the error allowed, as a share of the power by which the
    turbulence blurs an image at random (fidelity.py).  `dynamics`: options of WaveDynamics.
    `atmosphere` None is the identity.  Raises ValueError for values outside their range.
    """

    def __init__(
        self,
        atmosphere: Atmosphere | None,
        *,
        views: int | Sequence[Sequence[int]],
        height: int,
        width: int,
        fps: float = 120.0,
        tolerance: Any = 0.26,
        **dynamics: Any,
    ):
        check_option(height >= 1 and width >= 1, "frame", "at least 1 x 1", (height, width))
        check_option(0 < fps < math.inf, "fps", "> 0", fps)
        is_share = isinstance(tolerance, int | float) and 0 < tolerance <= 1
        check_option(is_share, "tolerance", "in (0, 1]", tolerance)
        self.dynamics = WaveDynamics(**dynamics)
        self.atmosphere, self.height, self.width, self.fps = atmosphere, height, width, fps
        positions = layout(views) if isinstance(views, int) else views
        self.positions = tuple((row, col) for row, col in positions)
        self.is_identity = atmosphere is None or atmosphere.d_over_r0 == 0
        self.fidelity = Fidelity()
        if atmosphere is not None and not self.is_identity:
            fidelity = choose_fidelity(atmosphere, width, tolerance)
            self.fidelity = fidelity = replace(fidelity, **self.dynamics.describe(atmosphere))
            strength, unit = fidelity.blur_equivalent_d_over_r0, fidelity.lambda_over_d_px
            size, number, band = fidelity.psf_size_px, fidelity.psf_network, find_psf_band(strength)
            missing = missing_structure_function(
                band.networks[number].modes, atmosphere.d_over_r0, strength,
                *atmosphere.outer_scale_and_profile,
            )  # fmt: skip
            self.psfs = FittedPSFs(band, number, fidelity.psf_rank, unit, size, missing)
            self.halo = PSFHalo(mean_short_exposure_psf(strength, missing), unit, size)

    @property
    def metadata(self) -> dict[str, float | int | str]:
        return asdict(self.fidelity)

    def clip_metadata(self, generator: Generator) -> dict[str, float | int | str]:
        """Return the metadata of the clip that `degrade` draws from `generator`: where clips are
        `mixed`, with the temporal model that it has.
        """
        if self.atmosphere is None or self.is_identity:
            return self.metadata
        model = self.dynamics.draw_temporal_model(noise.draw_base_key(generator))
        return self.metadata | replace(self.dynamics, temporal_model=model).describe(
            self.atmosphere
        )

    @torch.no_grad()
    def degrade(self, frames: Frames, generator: Generator, *, crop: Crop | None = None) -> Views:
        """Return every view of `crop`: only this is simulated, and is that part of the whole to
        rounding."""
        size, given = (self.height, self.width), tuple(frames.shape[-2:])
        check_option(given == size, "frame", f"{size}", given)
        top, left, height, width = crop or (0, 0, *size)
        inside = 0 <= top <= top + height <= size[0] and 0 <= left <= left + width <= size[1]
        check_option(inside and height > 0 and width > 0, "crop", f"inside the {size} frame", crop)
        if self.is_identity:
            part = frames[:, None, :, top : top + height, left : left + width]
            return part.expand(-1, len(self.positions), -1, -1, -1)
        seen = []
        for clip in frames.float():
            plans = self.plan(len(clip), generator, (top, left, height, width), clip.device)
            seen.append(render_views(clip, plans))
        return seen[0][None] if len(seen) == 1 else torch.stack(seen)

    @torch.no_grad()
    def tilt(self, frames: int, generator: Generator, *, crop: Crop | None = None) -> Tilt:
        window = crop or (0, 0, self.height, self.width)
        if self.is_identity:
            shape = len(self.positions), frames, 2, *window[2:]
            return torch.zeros(shape, dtype=torch.float32)
        return render_tilt(self.plan(frames, generator, window), frames)

    @torch.no_grad()
    def degrade_parts(
        self, parts: Iterable[Float[Tensor, "part h w"]], frames: int, generator: Generator
    ) -> Iterator[tuple[Float[Tensor, "views part h w"], Tilt]]:
        """Yield every view and the tilt of successive parts of one clip of `frames`, as `degrade`
        and `tilt` return them for all of it, in the memory of one part and of the amplitudes of all
        frames: 8 bytes for each of WAVES waves and each view.
        """
        window, first = (0, 0, self.height, self.width), 0
        plans = [] if self.is_identity else self.plan(frames, generator, window)
        for part in parts:
            stop = first + len(part)
            own = [plan.select_frames(first, stop, frames) for plan in plans]
            if own:
                yield render_views(part.float(), own), render_tilt(own, len(part))
            else:
                views = part.expand(len(self.positions), *part.shape)
                tilt_shape = *views.shape[:2], 2, *window[2:]
                yield views, torch.zeros(tilt_shape, dtype=torch.float32)
            first = stop

    def plan(
        self, frames: int, generator: Generator, window: Crop, device: torch.device | str = "cpu"
    ) -> list[TilePlan]:
        """Return the plans of the tiles of one clip, drawn on `device`; not of the identity."""
        atmosphere, key = self.atmosphere, noise.draw_base_key(generator)
        assert atmosphere is not None  # else it is the identity
        modes, wave_key = self.fidelity.zernike_modes, noise.key(key, "waves")
        waves = draw_plane_waves(
            atmosphere, wave_key, modes=modes, waves=WAVES, width_px=self.width
        )
        amplitudes = self.dynamics.draw_amplitudes(
            atmosphere, waves, key, self.positions, frames, self.fps, device
        )
        given, size = (self.fidelity, self.psfs, self.halo), (self.height, self.width)
        top, left, height, width = window
        tiles = [
            (top + y, left + x, min(TILE, height - y), min(TILE, width - x))
            for y in range(0, height, TILE)
            for x in range(0, width, TILE)
        ]
        return [plan_tile(tile, size, amplitudes, waves, *given) for tile in tiles]
