"""No more than a scene needs: how finely an atmosphere is simulated, and what that costs in error.

Errors are powers, as shares of the power by which turbulence at random changes a picture (its blur
against the mean blur, tilt apart) with the spectrum 1 / f^2 of natural ones.  The tables behind
them are measured on exact PSFs, over D/r0 and lambda / D in pixels, by scripts/fit_p2s/errors.py
and kept beside the networks.  Times are those of one core (AVX2) per pixel of a view; their ratio
is what counts.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from safetensors import safe_open
from torch import Tensor

from src.sim.turbulence import p2s
from src.sim.turbulence.atmosphere import TILT_VARIANCE, Atmosphere
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D
from src.sim.turbulence.unresolved_blur import StructureFunction, blur_by_phase
from src.sim.turbulence.zernike import noll_index

CONTRAST = 0.2  # rms contrast of a natural picture
UNSEEN = 0.5 / 255  # rms error that nobody needs to go below
TILT_ERROR = 0.35  # of the tilt's spread, per D between nodes
TILT_SHARE = 0.06  # of the spread, that interpolating the tilt may err by
MAX_PITCH = 64
MEAN_PSF_SIZE = 95  # samples: 24 lambda / D to either side, within which 98 % of the light falls
BLURRED = 0.88  # measured at 0.16 D, D/r0 4, two and three pixels between nodes
UNRELATED = 2.0  # the error of a PSF taken from a place that has nothing to do with it
WAVES = 540  # that a mode of order n sees, times n
NS_WAVE, NS_ROW = 0.023, 0.012  # a wave of a mode at a node, and for each pixel between nodes
NS_LAYER, NS_NODE = 0.040, 33.0  # a weight of a network at a node, and a node itself
NS_QUAD, NS_RANK = 1.1, 0.065  # four pixels of a PSF, and each basis function in them
NS_TAP, NS_BETWEEN = 0.15, 0.2  # a pixel of a PSF at work, on a row of nodes and between two


@dataclass(frozen=True)
class Fidelity:
    """One atmosphere in pixels, and how it is simulated; names as in Atmosphere mean the same.

    `temporal_model`, `wind_m_s`, `tilt_correlation_time_s`: see WaveDynamics.describe;
    `aperture_px`: D at the object; `tilt_px`: standard deviation along one axis; `blur_px`: blur
    beyond diffraction (Atmosphere.blur_px).  `zernike_modes` from tilt on; `psf_network`: the one
    that turns them into weights of `psf_rank` basis functions; `*_grid_pitch_px`: pixels between
    the nodes of the phase.  `psf_error` (modes left out, network and basis), `psf_grid_error`,
    `psf_size_error`: shares of the random power; `tilt_error_px`: of the tilt between nodes, rms;
    `simulation_error`: the rms error that the first three make, of an image's contrast.
    """

    d_over_r0: float = 0.0
    blur_equivalent_d_over_r0: float = 0.0
    severity: str = "none"
    rytov_variance: float = 0.0
    ar1_coefficient: float = 1.0
    temporal_model: str = "none"
    wind_m_s: float = 0.0
    tilt_correlation_time_s: float = math.inf
    tilt_and_blur_px: float = 0.0
    tilt_correlation_half_length_px: float = math.inf
    aperture_px: float = 0.0
    aperture_over_outer_scale: float = 0.0
    tilt_px: float = 0.0
    lambda_over_d_px: float = 0.0
    blur_px: float = 0.0
    zernike_modes: int = 0
    psf_network: int = 0
    psf_rank: int = 0
    psf_size_px: int = 1
    psf_grid_pitch_px: int = 1
    tilt_grid_pitch_px: int = 1
    psf_error: float = 0.0
    psf_grid_error: float = 0.0
    psf_size_error: float = 0.0
    tilt_error_px: float = 0.0
    simulation_error: float = 0.0


def choose_fidelity(atmosphere: Atmosphere, width_px: int, max_error_share: float) -> Fidelity:
    """Return the cheapest fidelity whose errors keep within `max_error_share` of the random power.

    An rms error of half a grey level of 256 is always allowed.
    Raises ValueError for turbulence that is too strong.
    """
    unit, strength = atmosphere.lambda_over_d_px(width_px), atmosphere.blur_equivalent_d_over_r0
    power = _random_power(strength, unit)
    allowed = max(max_error_share, (UNSEEN / CONTRAST) ** 2 / power)
    pixel = atmosphere.pixel_size_at_object_m(width_px) / atmosphere.aperture_m
    patch = pixel / _isoplanatic_patch_ratio(atmosphere)
    psf = choose_psf_settings(p2s.find_psf_band(strength), strength, unit, patch, allowed)
    tilt_px = atmosphere.tilt_std_px(width_px)
    tilt_pitch, error_tilt = _tilt_pitch(patch, tilt_px, unit, atmosphere.d_over_r0)
    return Fidelity(
        d_over_r0=atmosphere.d_over_r0,
        blur_equivalent_d_over_r0=strength,
        severity=atmosphere.severity,
        rytov_variance=atmosphere.rytov_variance,
        ar1_coefficient=atmosphere.ar1_coefficient,
        tilt_and_blur_px=atmosphere.tilt_and_blur_px(width_px),
        tilt_correlation_half_length_px=atmosphere.tilt_correlation_half_length_px(width_px),
        aperture_px=atmosphere.aperture_m / atmosphere.pixel_size_at_object_m(width_px),
        aperture_over_outer_scale=atmosphere.aperture_over_outer_scale,
        tilt_px=tilt_px,
        lambda_over_d_px=unit,
        blur_px=atmosphere.blur_px(width_px),
        tilt_grid_pitch_px=tilt_pitch,
        tilt_error_px=error_tilt,
        simulation_error=math.sqrt(
            power * (psf["psf_error"] + psf["psf_grid_error"] + psf["psf_size_error"])
        ),
        **psf,
    )


def mean_short_exposure_psf(
    d_over_r0: float, missing: StructureFunction
) -> Float[Tensor, "size size"]:
    """Return the mean PSF of Noll modes 4..120 at `d_over_r0` over MEAN_PSF_SIZE samples, blurred
    by phase of the structure function `missing` (unresolved_blur.py)."""
    stored = interpolate_log(error_table("mean"), error_table("strength"), d_over_r0)
    return blur_by_phase(stored / stored.sum(), missing, MEAN_PSF_SIZE)


def _isoplanatic_patch_ratio(atmosphere: Atmosphere) -> float:
    """Return how large the patches of like phase are, over those of a constant Cn2.

    The ratio of theta0 L / r0, Kolmogorov's: an outer scale does not change small distances.
    """
    place, strength = atmosphere.integrated_cn2_by_slice
    near = float((strength * (1 - place) ** (5 / 3)).sum())
    return (near / float((strength * place ** (5 / 3)).sum())) ** 0.6


def _tilt_pitch(
    pixel_d: float, tilt_px: float, lambda_over_d_px: float, d_over_r0: float
) -> tuple[int, float]:
    """Return the widest pitch within 0.03 px or TILT_SHARE of the spread, and its error.

    Cubic interpolation between nodes S D apart leaves an rms error of TILT_ERROR S of the spread of
    Kolmogorov's tilt, measured for a constant Cn2; an outer scale does not change that error.
    """
    allowed = max(0.03, TILT_SHARE * tilt_px)
    kolmogorov = 2 / math.pi * lambda_over_d_px * math.sqrt(TILT_VARIANCE) * d_over_r0 ** (5 / 6)
    error = TILT_ERROR * pixel_d * kolmogorov
    pitch = int(min(max(allowed / error, 1), MAX_PITCH))
    return pitch, error * pitch if pitch > 1 else 0.0


def _random_power(d_over_r0: float, lambda_over_d_px: float) -> float:
    """Return the power of the random change of a picture of unit contrast; grows as d^(5/3)."""
    table, strengths = error_table("power"), error_table("strength")
    weak = min(d_over_r0 / float(strengths[0]), 1.0) ** (5 / 3)
    power = float(interpolate_table(table, strengths, d_over_r0, lambda_over_d_px))
    return max(power * weak, 1e-30)


def choose_psf_settings(
    band: p2s.PSFBand, d_over_r0: float, lambda_over_d_px: float, pixel_d: float, allowed: float
) -> dict[str, Any]:
    """Return the cheapest settings, fields of Fidelity, whose error is `allowed`, or those of the
    least error.

    `pixel_d`: a pixel at the object in units of D, for a constant Cn2.
    """
    optics, number = (d_over_r0, lambda_over_d_px), p2s.load_bands_by_d_over_r0().index(band)
    table, strengths = (error_table(name)[number] for name in ("psf", "psf_strength"))
    psf = _errors_at_pitches(interpolate_table(table, strengths, *optics), pixel_d)
    ranks = [min(int(rank), len(band.basis)) for rank in error_table("rank_axis")]
    widest = band.mean.shape[-1] / SAMPLES_PER_LAMBDA_OVER_D / 2
    sizes = [  # odd numbers of pixels
        2 * math.floor(min(reach + 0.5 / lambda_over_d_px, widest) * lambda_over_d_px) + 1
        for reach in error_table("kernel_axis").tolist()
    ]
    kernel = interpolate_table(error_table("kernel"), error_table("strength"), *optics)
    total = psf[..., None] + kernel  # networks, pitches, ranks, kernels
    cost = _nanoseconds(band.networks, ranks, torch.tensor(sizes))
    within = total <= allowed
    best = torch.where(within, cost, math.inf) if within.any() else total
    n, p, r, k = (int(i) for i in torch.unravel_index(best.argmin(), best.shape))
    at_nodes, between = float(psf[n, 0, r]), float(psf[n, p, r])
    return {
        "zernike_modes": band.networks[n].modes, "psf_network": n, "psf_rank": ranks[r],
        "psf_grid_pitch_px": p + 1, "psf_size_px": sizes[k], "psf_error": at_nodes,
        "psf_grid_error": between - at_nodes, "psf_size_error": float(kernel[k]),
    }  # fmt: skip


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
    networks: Sequence[p2s.PhaseToSpaceNetwork], ranks: list[int], kernels: Tensor
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
    network: p2s.PhaseToSpaceNetwork, ranks: tuple[int, ...]
) -> Float[Tensor, "px ranks"]:
    px = torch.arange(1, MAX_PITCH + 1).float()
    waves = sum(WAVES / noll_index(mode)[0] for mode in range(4, network.modes + 2))
    node = NS_NODE + NS_LAYER * network.count_macs(torch.tensor(ranks))
    return node + waves * (NS_WAVE + NS_ROW * px[:, None])


def interpolate_table(
    table: Tensor, strengths: Tensor, d_over_r0: float, lambda_over_d_px: float
) -> Float[Tensor, "*axis"]:
    """Interpolate a table (D/r0 as `strengths`, ..., lambda / D) in the logarithm of both."""
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
    with safe_open(p2s.FILE, "pt") as file:
        return file.get_tensor(f"errors.{name}")
