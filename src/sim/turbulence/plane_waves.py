"""Zernike coefficients over image, time and views, as a sum of plane waves.

Turbulence along the path is von Karman phase, a sum of plane waves exp(2 pi i f.x), each in a thin
layer at its own distance z (sparse spectrum: Charnotskii 2013, J. Opt. Soc. Am. A 30, 479).  An
object point x sees the layer through a disc of diameter D_l = D (1 - z/L) centred at x z/L, so
Noll's coefficient j there is

    a_j(x, t) = Re sum_m c_m(t) w_m Q_j(D_l f_m) exp(2 pi i f_m . x z_m / L)

with Q_j the Fourier transform of the mode (zernike.py) and independent complex normal c_m.
All covariances, between modes, points, times and views, follow from this one sum.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Position, view_id
from src.sim.turbulence.atmosphere import AR1_FPS, Atmosphere
from src.sim.turbulence.contract import check_option
from src.sim.turbulence.outer_scale import LAYER_WIND_RATIO, tilt_decay_distance
from src.sim.turbulence.zernike import SPECTRUM, pupil_filter

LOW, HIGH = 0.08, 0.32  # limits of the three power laws that kappa is drawn from; HIGH per (n + 1)
DEPTH = 1.0  # waves are drawn with the density Cn2 (1 - z/L)^DEPTH
SHARES = (0.25, 0.65, 0.10)  # of the waves below LOW, between, above HIGH
TEMPORAL_MODELS, VIEWS_CORRELATIONS = ("ar1", "frozen_flow", "mixed"), ("independent", "baseline")
NUMBERS_AT_A_TIME = 1 << 22  # that are drawn, a few hundred MiB with all that is made of them
WIND_LAYERS = 4  # of equal integrals of Cn2 (1 - z/L)^DEPTH


@dataclass(frozen=True)
class PlaneWaves:
    """The plane waves of one clip; the same for its views, only their amplitudes differ.

    `frequency_per_px` (waves, 2): f z / L in cycles per pixel at the object along (x, y).
    `frequency_per_m` (waves, 2): f in cycles per metre in the layer; `z_over_l` (waves,);
    `nearer_share` (waves,): the share of the integral of Cn2 (1 - z/L) that is nearer the camera.
    `response` (modes, waves, 2): w_m Q_j, real and imaginary part, in rad.
    """

    frequency_per_px: Float[Tensor, "waves 2"]
    frequency_per_m: Float[Tensor, "waves 2"]
    z_over_l: Float[Tensor, " waves"]
    nearer_share: Float[Tensor, " waves"]
    response: Float[Tensor, "modes waves 2"]


def draw_plane_waves(
    atmosphere: Atmosphere, key: int, *, modes: int, waves: int, width_px: int
) -> PlaneWaves:
    """Draw `waves` plane waves that carry Noll modes 2..modes + 1.

    kappa = D_l |f|, its angle and z are drawn by a shifted Kronecker sequence, z with the density
    Cn2 (1 - z/L), kappa from a broken power law over all of (0, inf).  The weights w_m divide by
    these densities, so the expected covariance is exact.
    """
    u = _kronecker_sequence(key, waves)
    order = (math.isqrt(8 * (modes + 1) - 7) - 1) // 2
    high = HIGH * (order + 1) + 0.6
    # Waves hardly count below LOW, or what the outer scale sets.
    low = min(max(LOW, 0.3 * atmosphere.aperture_over_outer_scale), 0.5 * high)
    kappa, density = _draw_kappa(u[:, 0], low, high)
    angle = 2 * math.pi * u[:, 1]
    place, strength = atmosphere.integrated_cn2_by_slice
    near = 1 - place
    steps = torch.cumsum(strength * near**DEPTH, 0)
    slot = torch.searchsorted(steps, u[:, 2] * steps[-1]).clamp(max=len(place) - 1)
    count = near[slot] ** (5 / 3 - DEPTH) * steps[-1] / (strength * near ** (5 / 3)).sum()
    diameter = atmosphere.aperture_m * near[slot]
    kappa0 = diameter / atmosphere.outer_scale_m
    power = kappa * (kappa**2 + kappa0**2) ** (-11 / 6)
    variance = SPECTRUM * 2 * math.pi * power * count / (density * waves)
    amplitude = variance.sqrt() * atmosphere.d_over_r0 ** (5 / 6)
    layer = torch.stack([angle.cos(), angle.sin()], dim=-1) * (kappa / diameter)[:, None]
    return PlaneWaves(
        frequency_per_px=layer * place[slot, None] * atmosphere.pixel_size_at_object_m(width_px),
        frequency_per_m=layer,
        z_over_l=place[slot],
        nearer_share=u[:, 2],
        response=pupil_filter(kappa, angle, modes) * amplitude[:, None],
    )


@dataclass(frozen=True)
class WaveDynamics:
    """How turbulence evolves and what the views share of it.

    `temporal_model`: `ar1` (the paper: its coefficient per frame at 120 fps), `frozen_flow`, frozen
    turbulence in WIND_LAYERS layers each carried by a wind of its own, about `wind_m_s` (None: the
    atmosphere's), or `mixed`, one of the two drawn per clip.  `views_correlation`:
    `independent` (the paper) or `baseline`, sub-apertures `baseline_m` apart (None: touching)
    looking through the same turbulence.  Raises ValueError for values outside their range.
    """

    temporal_model: str = "ar1"
    wind_m_s: float | None = None
    views_correlation: str = "independent"
    baseline_m: float | None = None

    def __post_init__(self) -> None:
        time, shared = self.temporal_model, self.views_correlation
        checks = {
            "temporal_model": (time in TEMPORAL_MODELS, "ar1, frozen_flow or mixed"),
            "views_correlation": (shared in VIEWS_CORRELATIONS, "independent or baseline"),
        }
        for name in ("wind_m_s", "baseline_m"):
            value = getattr(self, name)
            valid = value is None or (isinstance(value, int | float) and 0 <= value < math.inf)
            checks[name] = (valid, ">= 0 or null")
        for name, (valid, allowed) in checks.items():
            check_option(valid, name, allowed, getattr(self, name))

    def draw_temporal_model(self, key: int) -> str:
        """Return `ar1` or `frozen_flow`; where clips are `mixed`, that of the clip of `key`."""
        if self.temporal_model != "mixed":
            return self.temporal_model
        drawn = float(noise.uniform(noise.key(key, "temporal"), torch.tensor(0)))
        return "frozen_flow" if drawn < 0.5 else "ar1"

    def describe(self, atmosphere: Atmosphere) -> dict[str, Any]:
        """Return what is recorded: `temporal_model`; `wind_m_s`, the rms speed of frozen flow, 0 of
        AR(1); `tilt_correlation_time_s`, to 1 / e (`mixed`: that of AR(1)).
        """
        coefficient = atmosphere.ar1_coefficient
        time_s, wind = math.inf if coefficient == 1 else 0.0, 0.0
        if 0 < coefficient < 1:
            time_s = -1 / (AR1_FPS * math.log(coefficient))
        if self.temporal_model != "ar1":
            wind = atmosphere.wind_m_s if self.wind_m_s is None else float(self.wind_m_s)
        if self.temporal_model == "frozen_flow":
            way = tilt_decay_distance(*atmosphere.outer_scale_and_profile, wind=True)
            time_s = way * atmosphere.aperture_m / wind if wind else math.inf
        own = {"temporal_model": self.temporal_model, "wind_m_s": wind}
        return own | {"tilt_correlation_time_s": time_s}

    def draw_amplitudes(
        self,
        atmosphere: Atmosphere,
        waves: PlaneWaves,
        key: int,
        positions: Sequence[Position],
        frames: int,
        fps: float,
        device: torch.device | str = "cpu",
    ) -> Complex[Tensor, "views frames waves"]:
        """Return complex64 amplitudes, drawn on `device`; of long clips a few views at a time, to
        save memory.

        Every view counts from its own id, or all from 0 where they share the turbulence.
        """
        together = max(1, NUMBERS_AT_A_TIME // (2 * frames * len(waves.z_over_l)))
        given = atmosphere, waves, key, frames, fps, device
        parts = [
            self._draw_views(positions[first : first + together], *given)
            for first in range(0, len(positions), together)
        ]
        return parts[0] if len(parts) == 1 else torch.cat(parts)

    def _draw_views(
        self, positions: Sequence[Position], atmosphere: Atmosphere, waves: PlaneWaves, key: int,
        frames: int, fps: float, device: torch.device | str,
    ) -> Complex[Tensor, "views frames waves"]:  # fmt: skip
        shared = self.views_correlation == "baseline"
        ids = torch.tensor([0 if shared else view_id(position) for position in positions])
        frozen = self.draw_temporal_model(key) == "frozen_flow"
        steps = 1 if frozen else frames
        counters = torch.arange(steps * 2 * len(waves.z_over_l), device=device)
        counters = counters.reshape(steps, -1, 2) + (ids << 40).to(device)[:, None, None, None]
        white = noise.normal(noise.key(key, "phase"), counters).double()
        if frozen:
            times = torch.arange(frames, device=device).double() / fps
            c = advect_waves(waves, white, self._draw_winds(key, atmosphere), times)
        else:
            c = _filter_ar1(white, atmosphere.ar1_coefficient ** (AR1_FPS / fps))
        if shared:  # the line of sight of a sub-aperture crosses a layer baseline (1 - z/L) away
            pitch = atmosphere.aperture_m if self.baseline_m is None else self.baseline_m
            baselines = torch.tensor(positions, dtype=torch.float64).flip(-1) * pitch
            cycles = (baselines @ waves.frequency_per_m.T) * (1 - waves.z_over_l)
            c = c * torch.exp(2j * math.pi * cycles).to(device)[:, None]
        return c.to(torch.complex64)

    def _draw_winds(self, key: int, atmosphere: Atmosphere) -> Float[Tensor, "layers 2"]:
        """Return the wind (x, y) of each layer in m/s: a common one, half as much of its own; the
        mean square is that of `wind_m_s`.
        """
        speed = atmosphere.wind_m_s if self.wind_m_s is None else self.wind_m_s
        turn = 2 * math.pi * float(noise.uniform(noise.key(key, "wind"), torch.tensor(0)))
        common = torch.tensor([math.cos(turn), math.sin(turn)], dtype=torch.float64)
        counters = torch.arange(2 * WIND_LAYERS).reshape(-1, 2)
        own = noise.normal(noise.key(key, "winds"), counters).double()
        own = own * LAYER_WIND_RATIO / math.sqrt(2)
        return speed / math.sqrt(1 + LAYER_WIND_RATIO**2) * (common + own)


def _filter_ar1(
    white: Float[Tensor, "views frames waves 2"], coefficient: float
) -> Complex[Tensor, "views frames waves"]:
    """Return c_t = a c_{t-1} + sqrt(1 - a^2) e_t, stationary from the first frame.

    By doubling: 41 frames take six steps.
    """
    share = torch.full_like(white[0, :, :1, :1], math.sqrt(1 - coefficient**2))
    share[0] = 1
    state, span = white * share, 1
    while span < state.shape[1]:  # it holds the draws of the last `span` frames, then of twice that
        later = state[:, span:] + coefficient**span * state[:, :-span]
        state = torch.cat([state[:, :span], later], dim=1)
        span *= 2
    return torch.view_as_complex(state)


def advect_waves(
    waves: PlaneWaves,
    white: Float[Tensor, "views 1 waves 2"],
    winds: Float[Tensor, "layers 2"],
    times_s: Float[Tensor, " frames"],
) -> Complex[Tensor, "views frames waves"]:
    """Return the amplitudes of turbulence that each layer's wind (x, y) in m/s carries along.

    The layers, from the camera on, have equal shares of the turbulence.  Taylor's hypothesis within
    each: phase(x, t) = phase(x - v t, 0), exact at any time, and smooth in it.
    """
    layer = (waves.nearer_share * len(winds)).long().clamp(max=len(winds) - 1)
    cycles_per_s = (waves.frequency_per_m * winds[layer]).sum(-1).to(white.device)
    shift = torch.exp(-2j * math.pi * times_s[:, None] * cycles_per_s)
    return torch.view_as_complex(white) * shift


def _kronecker_sequence(key: int, count: int) -> Float[Tensor, "count 3"]:
    """Return a Kronecker sequence in the unit cube, shifted at random: strata, angle, path.

    No small multiple of sqrt 3, the m of the modes, is near a whole number: angle and radius are
    independent.
    """
    shift = noise.uniform(key, torch.arange(3)).double()
    step = torch.tensor([1 / count, math.sqrt(3) - 1, (math.sqrt(5) - 1) / 2], dtype=torch.float64)
    stratum = torch.tensor([1 / count, 1, 1], dtype=torch.float32)
    return (shift * stratum + torch.arange(count)[:, None] * step) % 1.0


def _draw_kappa(u: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Return kappa and its density at the quantiles `u`: kappa^(-2/3), then 1/kappa, then ^-5.

    The first law makes all waves below `low` count alike for the tilt.
    """
    below, between, above = SHARES
    ratio = math.log(high / low)
    first = low * (u / below).clamp(max=1) ** 3
    middle = low * torch.exp(((u - below) / between).clamp(0, 1) * ratio)
    last = high * (1 - ((u - below - between) / above).clamp(0, 1 - 1e-9)) ** (-1 / 4)
    kappa = torch.where(u < below, first, torch.where(u < below + between, middle, last))
    kappa = kappa.clamp(min=1e-30)
    low_density = below / (3 * low ** (1 / 3)) * kappa ** (-2 / 3)
    high_density = above * 4 * high**4 * kappa**-5
    density = torch.where(kappa < high, between / (ratio * kappa), high_density)
    return kappa, torch.where(kappa < low, low_density, density)
