"""How finely PSFs are computed: the cheapest settings whose errors together are allowed.

Errors are those of fidelity.py, from tables kept beside the networks, which scripts/p2s_errors.py
measures on exact PSFs over D/r0 and lambda / D in pixels.  Times are those of one core (AVX2) per
pixel of a view; what counts is their ratio.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import torch
from jaxtyping import Float
from safetensors import safe_open
from torch import Tensor

from src.sim.turbulence.p2s import FILE, PSFBand, load_psf_bands
from src.sim.turbulence.p2s_network import PhaseToSpaceNetwork
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D
from src.sim.turbulence.zernike import noll_index

MAX_PITCH = 64
BLURRED = 0.88  # measured at 0.16 D, D/r0 4, two and three pixels between nodes
UNRELATED = 2.0  # the error of a PSF taken from a place that has nothing to do with it
WAVES = 540  # that a mode of order n sees, times n
NS_WAVE, NS_ROW = 0.023, 0.012  # a wave of a mode at a node, and for each pixel between nodes
NS_LAYER, NS_NODE = 0.040, 33.0  # a weight of a network at a node, and a node itself
NS_QUAD, NS_RANK = 1.1, 0.065  # four pixels of a PSF, and each basis function in them
NS_TAP, NS_BETWEEN = 0.15, 0.2  # a pixel of a PSF at work, on a row of nodes and between two


class PSFSettings(NamedTuple):
    """How PSFs are computed and what each simplification costs: fields of Fidelity."""

    zernike_modes: int
    psf_network: int
    psf_rank: int
    psf_grid_pitch_px: int
    psf_size_px: int
    error_psf: float
    error_grid: float
    error_kernel: float


def choose_psf_settings(
    band: PSFBand,
    d_over_r0: float,
    lambda_over_d_px: float,
    pixel_d: float,
    allowed_error: float,
) -> PSFSettings:
    """Return the cheapest settings whose error is `allowed_error`, or those of the least error.

    `pixel_d`: a pixel at the object in units of D, for a constant Cn2.
    """
    optics, number = (d_over_r0, lambda_over_d_px), load_psf_bands().index(band)
    table, strengths = (error_table(name)[number] for name in ("psf", "psf_strength"))
    psf = _errors_at_pitches(_interpolate(table, strengths, *optics), pixel_d)
    ranks = [min(int(rank), len(band.basis)) for rank in error_table("rank_axis")]
    widest = band.mean.shape[-1] / SAMPLES_PER_LAMBDA_OVER_D / 2
    sizes = [  # odd numbers of pixels
        2 * math.floor(min(reach + 0.5 / lambda_over_d_px, widest) * lambda_over_d_px) + 1
        for reach in error_table("kernel_axis").tolist()
    ]
    kernel = interpolate_table("kernel", *optics)
    total = psf[..., None] + kernel  # networks, pitches, ranks, kernels
    cost = _nanoseconds(band.networks, ranks, torch.tensor(sizes))
    within = total <= allowed_error
    best = torch.where(within, cost, math.inf) if within.any() else total
    n, p, r, k = (int(i) for i in torch.unravel_index(best.argmin(), best.shape))
    at_nodes, between = float(psf[n, 0, r]), float(psf[n, p, r])
    return PSFSettings(
        band.networks[n].modes, n, ranks[r], p + 1, sizes[k],
        at_nodes, between - at_nodes, float(kernel[k]),
    )  # fmt: skip


def _errors_at_pitches(
    errors: Float[Tensor, "networks pitches ranks"], pixel_d: float
) -> Float[Tensor, "networks px ranks"]:
    """Return the errors at nodes 1, 2, ... MAX_PITCH pixels apart, the table's first pitch being 0.

    The table's are of places anywhere between nodes; one pixel in pitch^2 lies on one.  And they
    change sign within a kernel, so that a picture sees BLURRED of their power.
    """
    axis = error_table("pitch_axis").double()
    px = torch.arange(2, MAX_PITCH + 1, dtype=torch.float64)
    step = pixel_d * px
    more = (errors[:, 1:] - errors[:, :1]).clamp(min=0).cummax(1).values
    high = torch.searchsorted(axis, step).clamp(1, len(axis) - 1)
    share = (step / axis[high - 1]).log() / (axis[high] / axis[high - 1]).log()
    low, up = more[:, high - 1], more[:, high]
    more = low + share.clamp(0, 1).float()[:, None] * (up - low)
    more[:, step > axis[-1]] = UNRELATED
    between = BLURRED * more * (1 - px**-2).float()[:, None]
    return errors[:, :1] + torch.cat([torch.zeros_like(errors[:, :1]), between], 1)


def _nanoseconds(
    networks: Sequence[PhaseToSpaceNetwork], ranks: list[int], kernels: Tensor
) -> Tensor:
    """Return nanoseconds a pixel (networks, px, ranks, kernels)."""
    px = torch.arange(1, MAX_PITCH + 1).float()
    nodes = torch.stack([_node_nanoseconds(network, tuple(ranks)) for network in networks])
    draw = (kernels + 1.0).square() / 4 * (NS_QUAD + NS_RANK * torch.tensor(ranks)[:, None])
    rows = nodes[..., None] / px[:, None, None] + draw
    tap = torch.where(px > 1, NS_BETWEEN, NS_TAP)
    return rows / px[:, None, None] + tap[:, None, None] * kernels.square()


@cache
def _node_nanoseconds(
    network: PhaseToSpaceNetwork, ranks: tuple[int, ...]
) -> Float[Tensor, "px ranks"]:
    px = torch.arange(1, MAX_PITCH + 1).float()
    waves = sum(WAVES / noll_index(mode)[0] for mode in range(4, network.modes + 2))
    node = NS_NODE + NS_LAYER * network.count_macs(torch.tensor(ranks))
    return node + waves * (NS_WAVE + NS_ROW * px[:, None])


def interpolate_table(
    name: str, d_over_r0: float, lambda_over_d_px: float
) -> Float[Tensor, "*axis"]:
    """Interpolate a table (D/r0, ..., lambda / D) in the logarithm of both."""
    return _interpolate(error_table(name), error_table("strength"), d_over_r0, lambda_over_d_px)


def _interpolate(
    table: Tensor, strengths: Tensor, d_over_r0: float, lambda_over_d_px: float
) -> Tensor:
    rows = interpolate_log(table, strengths, d_over_r0)
    return interpolate_log(rows.movedim(-1, 0), error_table("airy"), lambda_over_d_px)


def interpolate_log(rows: Tensor, axis: Tensor, value: float) -> Tensor:
    """Interpolate the `rows` at the values `axis` in the logarithm; held beyond its ends."""
    place = max(value, float(axis[0]))
    high = int((axis < place).sum().clamp(1, len(axis) - 1))
    low = high - 1
    share = math.log(place / float(axis[low])) / math.log(float(axis[high] / axis[low]))
    return rows[low] + (rows[high] - rows[low]) * min(share, 1.0)


@cache
def error_table(name: str) -> Tensor:
    """Return the table or axis of that name."""
    with safe_open(FILE, "pt") as file:
        return file.get_tensor(f"errors.{name}")
