"""Turbulence as an operator: clean frames in, what every view sees out; tilt first, then blur."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.atmosphere import Atmosphere
from src.sim.blur import interpolation, nodes_for, scatter, warp
from src.sim.optics import layout, view_id
from src.sim.phase import Waves, draw_waves
from src.sim.psf import fraunhofer_psf

Crop = tuple[int, int, int, int]  # top, left, height, width
AR1_FPS = 120.0  # the frame rate that Atmosphere.alpha is stated for
WAVES = 256


@dataclass(frozen=True)
class Fidelity:
    """What one atmosphere is, in pixels, and how finely it is simulated."""

    d_over_r0: float = 0.0
    rytov: float = 0.0
    tilt_px: float = 0.0
    airy_px: float = 0.0
    modes: int = 0
    kernel: int = 1
    pitch: int = 1


class Turbulence:
    """The atmosphere between a scene and the views of a light field.

    `views`: a number of views (see `optics.layout`) or a list of (row, col); frames are `height` x
    `width` pixels at `fps`.  `tolerance` is the error allowed.  `temporal`: `ar1` (the paper) or
    `flow`, the wind carrying the turbulence at `wind_m_s`.  `views_correlation`: `independent`
    (the paper) or `baseline`, sub-apertures `baseline_m` apart looking through the same air.
    """

    def __init__(
        self,
        atmosphere: Atmosphere | None,
        *,
        views: int | Sequence[Sequence[int]],
        height: int,
        width: int,
        fps: float = 120.0,
        tolerance: float = 0.05,
        temporal: str = "ar1",
        wind_m_s: float = 5.0,
        views_correlation: str = "independent",
        baseline_m: float | None = None,
    ):
        self.atmosphere = atmosphere
        self.positions = layout(views) if isinstance(views, int) else tuple(map(tuple, views))
        self.height, self.width, self.fps = height, width, fps
        self.temporal, self.wind_m_s = temporal, wind_m_s
        self.views_correlation, self.baseline_m = views_correlation, baseline_m
        self.fidelity = Fidelity()
        if atmosphere is not None:
            airy = atmosphere.airy_px(width)
            self.fidelity = Fidelity(
                d_over_r0=atmosphere.d_over_r0,
                rytov=atmosphere.rytov,
                tilt_px=atmosphere.tilt_std_px(width),
                airy_px=airy,
                modes=35,
                kernel=2 * math.ceil((3 + atmosphere.d_over_r0) * airy) + 1,
                pitch=max(1, int(0.2 * atmosphere.aperture_m / atmosphere.object_pixel_m(width))),
            )

    def degrade(
        self,
        frames: Float[Tensor, "n frames h w"],
        generator: torch.Generator,
        *,
        crop: Crop | None = None,
    ) -> Float[Tensor, "n views frames hc wc"]:
        """Return what every view sees; `crop` (top, left, height, width) limits the work to it."""
        top, left, height, width = crop or (0, 0, self.height, self.width)
        if self.atmosphere is None:
            window = frames[:, None, :, top : top + height, left : left + width]
            return window.expand(-1, len(self.positions), -1, -1, -1)
        keys = [noise.base_key(generator) for _ in range(len(frames))]
        return torch.stack(
            [
                self._clip(clip, key, (top, left, height, width))
                for clip, key in zip(frames, keys, strict=True)
            ]
        )

    def tilt(self, key: int, frames: int, crop: Crop | None = None) -> Tensor:
        """Return the tilt in pixels along (x, y): (views, frames, 2, h, w)."""
        waves = self._waves(key)
        window = crop or (0, 0, self.height, self.width)
        amplitudes = self._amplitudes(key, waves, frames)
        return torch.stack([self._tilt(waves, c, window) for c in amplitudes])

    def _clip(self, frames: Tensor, key: int, crop: Crop) -> Tensor:
        waves = self._waves(key)
        return torch.stack(
            [self._view(frames, waves, c, crop) for c in self._amplitudes(key, waves, len(frames))]
        )

    def _view(self, frames: Tensor, waves: Waves, c: Tensor, crop: Crop) -> Tensor:
        top, left, height, width = crop
        reach = self.fidelity.kernel // 2
        window = (top - reach, left - reach, height + 2 * reach, width + 2 * reach)
        tilted = warp(frames, self._tilt(waves, c, window), *window[:2])
        psfs = fraunhofer_psf(
            self._coefficients(waves, c, window).movedim(1, -1),
            airy_px=self.fidelity.airy_px,
            size=self.fidelity.kernel,
        )
        vertical = interpolation(window[0], window[2], self.fidelity.pitch).to(psfs)
        horizontal = interpolation(window[1], window[3], self.fidelity.pitch).to(psfs)
        return scatter(tilted, psfs, vertical, horizontal)

    def _tilt(self, waves: Waves, c: Tensor, window: Crop) -> Tensor:
        pitch = self.fidelity.pitch
        field = self._field(waves, c, slice(0, 2), window)
        vertical = interpolation(window[0], window[2], pitch).to(field)
        horizontal = interpolation(window[1], window[3], pitch).to(field)
        return (2 / math.pi * self.fidelity.airy_px) * (vertical @ field @ horizontal.T)

    def _coefficients(self, waves: Waves, c: Tensor, window: Crop) -> Tensor:
        blur = self._field(waves, c, slice(2, None), window)
        return torch.cat([torch.zeros_like(blur[:, :2]), blur], dim=1)

    def _field(self, waves: Waves, c: Tensor, modes: slice, window: Crop) -> Tensor:
        """Return Noll coefficients (frames, modes, rows, columns) on the nodes of `window`."""
        pitch = self.fidelity.pitch
        rows = (
            torch.arange(nodes_for(window[0], window[2], pitch)[1])
            + nodes_for(window[0], window[2], pitch)[0]
        )
        columns = (
            torch.arange(nodes_for(window[1], window[3], pitch)[1])
            + nodes_for(window[1], window[3], pitch)[0]
        )
        x = columns * pitch - (self.width - 1) / 2
        y = rows * pitch - (self.height - 1) / 2
        turn = torch.view_as_complex(waves.response[modes]) * c[:, None]
        across = torch.polar(torch.ones(()).double(), 2 * math.pi * waves.frequency[:, :1] * x)
        down = torch.polar(torch.ones(()).double(), 2 * math.pi * waves.frequency[:, 1:] * y)
        points = (down[:, :, None] * across[:, None]).flatten(1)
        field = (turn.flatten(0, 1) @ points).real.float()
        return field.reshape(len(c), -1, len(rows), len(columns))

    def _waves(self, key: int) -> Waves:
        return draw_waves(
            self.atmosphere,
            noise.key(key, "waves"),
            modes=self.fidelity.modes,
            waves=WAVES,
            width_px=self.width,
        )

    def _amplitudes(self, key: int, waves: Waves, frames: int) -> Tensor:
        """Return the waves' complex amplitudes, (views, frames, waves)."""
        count = len(waves.place)
        alpha = self.atmosphere.alpha ** (AR1_FPS / self.fps)
        counters = torch.arange(frames * count * 2).reshape(frames, count, 2)
        views = []
        for position in self.positions:
            fresh = noise.normal(noise.key(key, view_id(position), "phase"), counters).double()
            state = [fresh[0]]
            for step in fresh[1:]:
                state.append(alpha * state[-1] + math.sqrt(1 - alpha**2) * step)
            views.append(torch.view_as_complex(torch.stack(state)))
        return torch.stack(views)
