"""How finely PSFs are computed: the cheapest way whose errors together are allowed.

Errors are those of fidelity.py.  Times are those of one core (AVX2, nothing else running) per pixel
of a view; what counts is their ratio.
"""

import math
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.turbulence.grids import at, between, table
from src.sim.turbulence.p2s import FINE_PER_AIRY, Band, band_for, bands
from src.sim.turbulence.p2s_network import Network
from src.sim.turbulence.zernike import noll_index

SHARES = {"psf": 0.57, "pitch": 0.33, "kernel": 0.1}  # of what is allowed, where PSFs are exact
EXACT_MODES = 119  # whole orders up to n = 14, for D/r0 beyond the tables
MOST_MODES = 200
MAX_PITCH = 64
BLURRED = 0.88  # measured at 0.16 D, D/r0 4, two and three pixels between nodes
UNRELATED = 2.0  # the error of a PSF taken from a place that has nothing to do with it
WAVES = 540  # that a mode of order n sees, times n
NS_WAVE, NS_ROW = 0.023, 0.012  # a wave of a mode at a node, and for each pixel between nodes
NS_LAYER, NS_NODE = 0.040, 33.0  # a weight of a network at a node, and a node itself
NS_QUAD, NS_RANK = 1.1, 0.065  # four pixels of a PSF, and each basis function in them
NS_TAP, NS_BETWEEN = 0.15, 0.2  # a pixel of a PSF at work, on a row of nodes and between two


class Choice(NamedTuple):
    """Noll modes, the network and its basis functions, pixels between nodes and across the kernel;
    what they err."""

    modes: int
    network: int
    rank: int
    pitch: int
    kernel: int
    error_psf: float
    error_pitch: float
    error_kernel: float


def fitted(
    band: Band, strength: float, airy: float, pixel: float, allowed: float, given: int | None
) -> Choice:
    """Return the cheapest choice whose error is `allowed`, or that of the least error.

    `pixel`: in units of D at the object, of air whose Cn2 is constant.  The number of modes may be
    `given`; an error is then stated as if the rest were missing, though a network adds their mean
    blur.
    """
    modes = _given(given, band.networks[-1].modes, "fitted")
    known = [n for n, network in enumerate(band.networks) if network.modes >= modes]
    psf = _at_pitches(psf_errors(band, strength, airy)[known], pixel)
    ranks = [min(int(rank), len(band.basis)) for rank in table("rank_axis")]
    kernels = [_kernel(strength, airy, reach) for reach in table("kernel_axis").tolist()]
    total = psf[..., None] + at("kernel", strength, airy)  # networks, pitches, ranks, kernels
    cost = _ns([band.networks[n] for n in known], ranks, torch.tensor(kernels))
    within = total <= allowed
    best = torch.where(within, cost, math.inf) if within.any() else total
    n, p, r, k = (int(i) for i in torch.unravel_index(best.argmin(), best.shape))
    own, every = float(psf[n, 0, r]), float(psf[n, p, r])
    left = _left_out(strength, airy, modes) if modes else 0.0
    return Choice(
        given or band.networks[known[n]].modes, known[n], ranks[r], p + 1, kernels[k],
        max(own, left), every - own, float(at("kernel", strength, airy)[k]),
    )  # fmt: skip


def exact(strength: float, airy: float, pixel: float, allowed: float, given: int | None) -> Choice:
    """Return the same for exact PSFs: network and rank are 0, each error has a share of its own."""
    modes, error = _given(given, MOST_MODES, "exact"), 0.0
    if modes:
        error = _left_out(strength, airy, modes)
    else:
        modes, error = _cheapest("modes", strength, airy, SHARES["psf"] * allowed)
        modes = int(modes) if band_for(strength) else EXACT_MODES
    reach, error_kernel = _cheapest("kernel", strength, airy, SHARES["kernel"] * allowed)
    step, error_pitch = _widest(strength, airy, SHARES["pitch"] * allowed)
    pitch = int(min(max(step / pixel, 1), MAX_PITCH))
    error_pitch = error_pitch if pitch > 1 else 0.0
    kernel = _kernel(strength, airy, reach)
    return Choice(modes, 0, 0, pitch, kernel, error, error_pitch, error_kernel)


def psf_errors(band: Band, strength: float, airy: float) -> Float[Tensor, "networks pitches ranks"]:
    """Return the errors of network, distance of nodes (the first is 0) and rank together."""
    number = bands().index(band)
    rows = between(table("psf")[number], table("psf_strength")[number], strength)
    return between(rows.movedim(-1, 0), table("airy"), airy)


def _given(modes: int | None, most: int, kind: str) -> int:
    if modes is not None and not 2 <= modes <= most:
        raise ValueError(f"turbulence.modes must be in [2, {most}] with {kind} PSFs, got {modes}")
    return modes or 0


def _at_pitches(
    errors: Float[Tensor, "networks pitches ranks"], pixel: float
) -> Float[Tensor, "networks px ranks"]:
    """Return the errors at nodes 1, 2, ... MAX_PITCH pixels apart.

    The table's are of places anywhere between nodes; one pixel in pitch^2 lies on one.  And they
    change sign within a kernel, so that a picture sees BLURRED of their power.
    """
    axis = table("pitch_axis").double()
    px = torch.arange(2, MAX_PITCH + 1, dtype=torch.float64)
    step = pixel * px
    more = (errors[:, 1:] - errors[:, :1]).clamp(min=0).cummax(1).values
    high = torch.searchsorted(axis, step).clamp(1, len(axis) - 1)
    share = (step / axis[high - 1]).log() / (axis[high] / axis[high - 1]).log()
    low, up = more[:, high - 1], more[:, high]
    more = low + share.clamp(0, 1).float()[:, None] * (up - low)
    more[:, step > axis[-1]] = UNRELATED
    return errors[:, :1] + torch.cat(
        [torch.zeros_like(errors[:, :1]), BLURRED * more * (1 - px**-2).float()[:, None]], 1
    )


def _ns(networks: list[Network], ranks: list[int], kernels: Tensor) -> Tensor:
    """Return nanoseconds a pixel (networks, px, ranks, kernels)."""
    px = torch.arange(1, MAX_PITCH + 1).float()
    nodes = torch.stack([_node_ns(network, tuple(ranks)) for network in networks])
    draw = (kernels + 1.0).square() / 4 * (NS_QUAD + NS_RANK * torch.tensor(ranks)[:, None])
    rows = nodes[..., None] / px[:, None, None] + draw
    tap = torch.where(px > 1, NS_BETWEEN, NS_TAP)
    return rows / px[:, None, None] + tap[:, None, None] * kernels.square()


@cache
def _node_ns(network: Network, ranks: tuple[int, ...]) -> Float[Tensor, "px ranks"]:
    """Return nanoseconds a node."""
    px = torch.arange(1, MAX_PITCH + 1).float()
    waves = sum(WAVES / noll_index(mode)[0] for mode in range(4, network.modes + 2))
    node = NS_NODE + NS_LAYER * network.macs(torch.tensor(ranks))
    return node + waves * (NS_WAVE + NS_ROW * px[:, None])


def _kernel(strength: float, airy: float, reach: float) -> int:
    """Return the odd number of pixels that `reach` lambda / D cover, within the basis if any."""
    band = band_for(strength)
    widest = band.mean.shape[-1] / FINE_PER_AIRY / 2 if band else 6 + 0.6 * strength
    reach = reach if band else widest
    return 2 * math.floor(min(reach + 0.5 / airy, widest) * airy) + 1


def _cheapest(name: str, strength: float, airy: float, limit: float) -> tuple[float, float]:
    """Return the first entry of the table's axis within `limit`, and its error."""
    errors = at(name, strength, airy)
    within = (errors <= limit).nonzero()
    index = int(within[0]) if len(within) else len(errors) - 1
    return float(table(f"{name}_axis")[index]), float(errors[index])


def _left_out(strength: float, airy: float, modes: int) -> float:
    """Return the error of exact PSFs of the first `modes` modes; without any blur it is 1."""
    covered = int((table("modes_axis") <= modes).sum())
    return float(at("modes", strength, airy)[covered - 1]) if covered else 1.0


def _widest(strength: float, airy: float, limit: float) -> tuple[float, float]:
    """Return the widest pitch in units of D at the object whose error is allowed, and the error."""
    errors, axis = at("pitch", strength, airy).cummax(0).values, table("pitch_axis")
    if limit >= UNRELATED:
        return math.inf, UNRELATED
    if limit <= errors[0]:  # the error falls at least with the first power of the pitch
        return float(axis[0] * limit / errors[0]), float(limit)
    index = min(int((errors <= limit).sum()) - 1, len(axis) - 2)
    share = (limit - errors[index]) / (errors[index + 1] - errors[index]).clamp(min=1e-9)
    share = float(share.clamp(0, 1))
    step = axis[index] * (axis[index + 1] / axis[index]) ** share
    return float(step), float(errors[index] + share * (errors[index + 1] - errors[index]))
