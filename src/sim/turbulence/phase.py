"""Zernike coefficients over picture, time and views, as a sum of plane waves.

Turbulence along the path is von Karman phase, a sum of plane waves exp(2 pi i f.x), each in a thin
layer at its own distance z (sparse spectrum: Charnotskii 2013, J. Opt. Soc. Am. A 30, 479).  An
object point x sees the layer through a disc of diameter D_l = D (1 - z/L) centred at x z/L, so
Noll's coefficient j there is

    a_j(x, t) = Re sum_m c_m(t) w_m Q_j(D_l f_m) exp(2 pi i f_m . x z_m / L)

with Q_j the Fourier transform of the mode (zernike.py) and independent complex normal c_m.
All covariances, between modes, points, times and views, follow from this one sum: nothing is
periodic, and frequencies reach down to zero.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from src.sim import noise
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.zernike import SPECTRUM, pupil_filter

LOW, HIGH = 0.08, 0.32  # limits of the three power laws that kappa is drawn from; HIGH per (n + 1)
DEPTH = 1.0  # waves are drawn with the density Cn2 (1 - z/L)^DEPTH
SHARES = (0.25, 0.65, 0.10)  # of the waves below LOW, between, above HIGH


@dataclass(frozen=True)
class Waves:
    """The plane waves of one clip; the same for its views, only their amplitudes differ.

    `frequency` (waves, 2): f z / L in cycles per pixel at the object along (x, y).
    `layer` (waves, 2): f in cycles per metre in the layer; `place` (waves,): z / L; `share`
    (waves,): how much of the turbulence lies nearer to the camera.
    `response` (modes, waves, 2): w_m Q_j, real and imaginary part, in rad.
    """

    frequency: Float[Tensor, "waves 2"]
    layer: Float[Tensor, "waves 2"]
    place: Float[Tensor, " waves"]
    share: Float[Tensor, " waves"]
    response: Float[Tensor, "modes waves 2"]


def draw_waves(atmosphere: Atmosphere, key: int, *, modes: int, waves: int, width_px: int) -> Waves:
    """Draw `waves` plane waves that carry Noll modes 2..modes + 1.

    kappa = D_l |f|, its angle and z are drawn by a shifted Kronecker sequence; z with the density
    Cn2 (1 - z/L), which draws more waves near the object than count there: they are fine, and
    a strong one would be seen as a stripe; kappa from a broken power law over all of (0, inf).  The
    weights w_m divide by these densities, so the expected covariance is exact.  An
    outer scale weakens waves longer than it, and few of them are drawn.
    """
    u = _sequence(key, waves)
    # Waves hardly count below LOW, or what the outer scale sets.
    low = min(max(LOW, 0.3 * atmosphere.inverse_outer_scale), 0.5 * _highest(modes))
    kappa, density = _radius(u[:, 0], modes, low)
    angle = 2 * math.pi * u[:, 1]
    place, strength = atmosphere.path
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
    pixel = atmosphere.object_pixel_m(width_px)
    return Waves(
        frequency=layer * place[slot, None] * pixel,
        layer=layer,
        place=place[slot],
        share=u[:, 2],
        response=pupil_filter(kappa, angle, modes) * amplitude[:, None],
    )


def evolve(
    fresh: Float[Tensor, "views frames waves 2"], alpha: float
) -> Complex[Tensor, "views frames waves"]:
    """Return c_t = alpha c_{t-1} + sqrt(1 - alpha^2) e_t, stationary from the first frame.

    By doubling: 41 frames take six steps.
    """
    share = torch.full_like(fresh[0, :, :1, :1], math.sqrt(1 - alpha**2))
    share[0] = 1
    state, span = fresh * share, 1
    while span < state.shape[1]:  # it holds the draws of the last `span` frames, then of twice that
        state = torch.cat(
            [state[:, :span], state[:, span:] + alpha**span * state[:, :-span]], dim=1
        )
        span *= 2
    return torch.view_as_complex(state)


def flow(
    waves: Waves,
    fresh: Float[Tensor, "views 1 waves 2"],
    winds: Float[Tensor, "layers 2"],
    seconds: Float[Tensor, " frames"],
) -> Complex[Tensor, "views frames waves"]:
    """Return the amplitudes of turbulence that each layer's wind (x, y) in m/s carries along.

    The layers, from the camera on, have equal shares of the turbulence.  Taylor's hypothesis within
    each: phase(x, t) = phase(x - v t, 0), exact at any time, and smooth in it.
    """
    wind = winds[(waves.share * len(winds)).long().clamp(max=len(winds) - 1)]
    speed = (waves.layer * wind).sum(-1).to(fresh.device)
    return torch.view_as_complex(fresh) * torch.exp(-2j * math.pi * seconds[:, None] * speed)


def look_from(waves: Waves, baselines: Float[Tensor, "views 2"]) -> Complex[Tensor, "views waves"]:
    """Return the phase of each wave seen from sub-apertures at `baselines` (x, y) in metres.

    Their line of sight to an object point crosses a layer baseline (1 - z/L) away.
    """
    return torch.exp(2j * math.pi * (baselines @ waves.layer.T) * (1 - waves.place))


def _sequence(key: int, count: int) -> Float[Tensor, "count 3"]:
    """Return a Kronecker sequence in the unit cube, shifted at random: strata, angle, path.

    sqrt 3 for the angle because none of its small multiples, the m of the modes, is near a whole
    number; that would tie the angle to the radius and spoil the mode's variance in every clip.
    """
    shift = noise.uniform(key, torch.arange(3)).double()
    step = torch.tensor([1 / count, math.sqrt(3) - 1, (math.sqrt(5) - 1) / 2], dtype=torch.float64)
    return (shift * torch.tensor([1 / count, 1, 1]) + torch.arange(count)[:, None] * step) % 1.0


def _highest(modes: int) -> float:
    order = (math.isqrt(8 * (modes + 1) - 7) - 1) // 2
    return HIGH * (order + 1) + 0.6


def _radius(u: Tensor, modes: int, low: float) -> tuple[Tensor, Tensor]:
    """Return kappa and its density at the quantiles `u`: kappa^(-2/3), then 1/kappa, then ^-5.

    The first law makes all waves below `low` count alike for the tilt, whose variance converges as
    slowly as kappa^(1/3) towards zero.
    """
    high = _highest(modes)
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
