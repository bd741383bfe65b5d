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
from functools import cached_property
from itertools import pairwise

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from src.sim import noise
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.zernike import SPECTRUM, noll_index, pupil_filter

LOW, HIGH = 0.08, 0.32  # limits of the three power laws that kappa is drawn from; HIGH per (n + 1)
FAINT = 1e-4, 3e-3  # of the variance of the modes of an order, tilt and the rest, left out
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


class Field:
    """The Noll coefficients of `modes` (0 is x-tilt) on the nodes of two lattices, in rad.

    `size` is the frame's (height, width); the axis of the camera goes through its middle.  A wave
    on a lattice is its rows times its columns, so the sum over waves is a product of matrices, one
    for all modes of an order n, over the waves which that order sees; of the columns only half is
    computed, since what is even about the middle column and what is odd serve the other half too.
    """

    def __init__(
        self,
        waves: Waves,
        modes: slice,
        rows: Lattice,
        columns: Lattice,
        size: tuple[int, int],
        device: torch.device,
    ):
        middle = (columns.pixels[0] + columns.pixels[-1]) / 2
        turned = torch.complex(*_turns(waves.frequency[:, 0], middle - (size[1] - 1) / 2))
        response = torch.view_as_complex(waves.response[modes]).to(torch.complex64) * turned
        down = _turns(waves.frequency[:, 1], rows.pixels - (size[0] - 1) / 2)
        half = columns.pixels[len(columns.pixels) // 2 :] - middle
        across = _turns(waves.frequency[:, 0], half)
        self.orders = []
        for own in _orders(modes.start or 0, len(response)):
            seen = _seen(response[own], FAINT[own.start + (modes.start or 0) > 1])
            tables = [part[seen].T.contiguous() for part in down] + [part[seen] for part in across]
            parts = [part.to(device) for part in (response[own][:, seen], *tables)]
            self.orders.append((own, seen, *parts))
        self.shape = (len(response), len(rows.pixels), len(columns.pixels))
        self.rows, self.columns, self.device = rows, columns, device

    def at_nodes(
        self, amplitudes: Complex[Tensor, "frames waves"]
    ) -> Float[Tensor, "modes frames rows columns"]:
        """Return the coefficients on the nodes: Re sum_m c_m w_m Q_j exp(2 pi i f_m . x)."""
        modes, rows, columns = self.shape
        out = torch.empty(modes, len(amplitudes), rows, columns, device=self.device)
        left = columns // 2
        for own, seen, response, cos_down, sin_down, cos, sin in self.orders:
            turn = (response[:, None] * amplitudes[:, seen])[:, :, None]
            real, imag = turn.real.contiguous(), turn.imag.contiguous()
            even = (real * cos_down).addcmul_(imag, sin_down, value=-1).flatten(0, 2) @ cos
            odd = (real * sin_down).addcmul_(imag, cos_down).flatten(0, 2) @ sin
            lines = out[own].view(-1, columns)
            torch.sub(even, odd, out=lines[:, left:])
            lines[:, :left] = even.add_(odd)[:, columns % 2 :].flip(1)
        return out

    def at_pixels(
        self, amplitudes: Complex[Tensor, "frames waves"]
    ) -> Float[Tensor, "modes frames h w"]:
        """Return the coefficients on all pixels that the lattices serve."""
        field = self.at_nodes(amplitudes)
        if self.rows.pitch > 1:
            field = self._vertical @ field
        return field @ self._horizontal if self.columns.pitch > 1 else field

    @cached_property
    def _vertical(self) -> Float[Tensor, "h rows"]:
        return self.rows.weights().to(self.device)

    @cached_property
    def _horizontal(self) -> Float[Tensor, "columns w"]:
        return self.columns.weights().T.to(self.device)


def evolve(
    fresh: Float[Tensor, "views frames waves 2"], alpha: float
) -> Complex[Tensor, "views frames waves"]:
    """Return c_t = alpha c_{t-1} + sqrt(1 - alpha^2) e_t, stationary from the first frame."""
    state, states = fresh[:, 0], [fresh[:, 0]]
    for step in fresh.unbind(1)[1:]:
        state = alpha * state + math.sqrt(1 - alpha**2) * step
        states.append(state)
    return torch.view_as_complex(torch.stack(states, dim=1))


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
    speed = (waves.layer * wind).sum(-1)
    return torch.view_as_complex(fresh) * torch.exp(-2j * math.pi * seconds[:, None] * speed)


def look_from(waves: Waves, baselines: Float[Tensor, "views 2"]) -> Complex[Tensor, "views waves"]:
    """Return the phase of each wave seen from sub-apertures at `baselines` (x, y) in metres.

    Their line of sight to an object point crosses a layer baseline (1 - z/L) away.
    """
    return torch.exp(2j * math.pi * (baselines @ waves.layer.T) * (1 - waves.place))


def _orders(first: int, count: int) -> list[slice]:
    """Return the modes first .. first + count - 1 (0 is x-tilt) by order n, numbered from 0."""
    order = [noll_index(mode + 2)[0] for mode in range(first, first + count)]
    edges = [i for i in range(count + 1) if i in (0, count) or order[i] != order[i - 1]]
    return [slice(*pair) for pair in pairwise(edges)]


def _seen(response: Complex[Tensor, "modes waves"], faint: float) -> Int[Tensor, " some"]:
    """Return the waves that make up the modes' variance, all but `faint` of it."""
    share = response.abs().square().sum(0)
    strength, order = share.sort()
    kept = order[strength.cumsum(0) > faint * strength.sum()]
    return kept.sort().values


def _turns(frequency: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Return cos and sin of 2 pi f x, float32 (waves, *places), of every wave at every place.

    Whole turns are taken off in float64.
    """
    place = torch.as_tensor(place).double()
    turns = frequency.reshape(-1, *[1] * place.ndim) * place
    angle = (2 * math.pi * (turns - turns.round())).float()
    return angle.cos(), angle.sin()


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
