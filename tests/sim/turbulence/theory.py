"""Closed forms and integrals that simulated turbulence is compared with."""

import copy
import math
from dataclasses import replace

import numpy as np
import torch
from scipy import optimize, special
from torch.nn import functional

from scripts.exact_psf import fraunhofer_psf, noll_covariance
from src.sim import noise
from src.sim.turbulence import clip_rendering
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.coefficient_grid import WaveSum
from src.sim.turbulence.contract import Crop
from src.sim.turbulence.engines import blur_torch
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.p2s import FittedPSFs
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D, pixel_integration_matrix
from src.sim.turbulence.unresolved_blur import blur_by_unresolved_modes


def isoplanatic_angle_rad(path: Atmosphere) -> float:
    """Return the angle over which the phase differs by 1 rad rms, from the camera; inf if none.

    Without an outer scale theta0 = [2.914 k^2 Int Cn2 z^(5/3) dz]^(-3/5) (Fried 1982).
    """
    place, strength = (part.numpy() for part in path.integrated_cn2_by_slice)
    z, k = place * path.distance_m, 2 * math.pi / path.wavelength_m
    integral = 2.914 * k**2 * float((strength * z ** (5 / 3)).sum())
    if integral == 0:
        return math.inf
    angle = integral**-0.6
    if math.isinf(path.outer_scale_m):
        return angle

    def excess(log_angle: float) -> float:
        structure = structure_function(math.exp(log_angle) * z, path.outer_scale_m)
        return 2.914 * k**2 * float((strength * structure).sum()) - 1

    if excess(math.log(1e6 * angle)) < 0:
        return math.inf
    return math.exp(optimize.brentq(excess, math.log(angle), math.log(1e6 * angle)))


def structure_function(apart: np.ndarray, outer_scale_m: float) -> np.ndarray:
    """Return the structure function of phase over 2.914 k^2 Int Cn2 dz; apart^(5/3) without L0.

    Von Karman: proportional to 1 - 2^(1/6) / Gamma(5/6) x^(5/6) K_(5/6)(x), x = 2 pi apart / L0.
    """
    x = 2 * math.pi * np.asarray(apart) / outer_scale_m
    order = 5 / 6
    near = special.gamma(1 / 6) / special.gamma(11 / 6) * (math.pi / outer_scale_m) ** (5 / 3)
    return (1 - 2 ** (1 - order) / special.gamma(order) * x**order * special.kv(order, x)) / near


def noll_residual(modes: int) -> float:
    """Return the phase variance left at D/r0 = 1 when Noll modes 1..modes are known, in rad^2.

    From the variances, summed over whole orders; 1.0324 for modes = 1 (Noll 1976, table IV).
    """
    known = float(noll_covariance(modes - 1).diagonal().sum()) if modes > 1 else 0.0
    return structure_variance() - known


def structure_variance() -> float:
    """Return the piston-removed variance at D/r0 = 1: half the mean over the pupil of 6.88
    (s/D)^(5/3).

    The distance s of two points of a disc has the density 16 s / pi (acos s - s sqrt(1 - s^2)) in
    units of its diameter; the mean is then a difference of beta functions.
    """
    structure = 2 * (24 / 5 * special.gamma(6 / 5)) ** (5 / 6)  # 6.8839
    power = 5 / 3
    half = (power + 3) / 2
    mean = special.beta(half, 0.5) / (power + 2) - special.beta(half, 1.5)
    return float(structure / 2 * 8 / math.pi * mean)


def draw_phases(count: int, d_over_r0: float, modes: int, tilt: bool = False) -> torch.Tensor:
    """Return Noll 2..modes + 1 (count, modes) in rad, always the same; without `tilt` that is 0."""
    mix = torch.linalg.cholesky(noll_covariance(modes)).float() * d_over_r0 ** (5 / 6)
    phases = torch.randn(count, modes, generator=noise.generator(3)) @ mix.T
    phases[:, :2] *= tilt
    return phases


def compute_fitted_psfs(psfs: FittedPSFs, phase: torch.Tensor, d_over_r0: float) -> torch.Tensor:
    """Return the PSFs (pixels, n) of Noll 4, 5, ... (blurmodes, n) in rad, none of it negative."""
    weights = psfs.network.merge_into_few_matrices(len(phase), d_over_r0)(phase)
    return (psfs.basis.flatten(1).T @ weights).clamp(min=0)


def exact_psfs_of_all_modes(
    coefficients: torch.Tensor, turbulence: Turbulence, size: int
) -> torch.Tensor:
    """Return exact PSFs (*n, size, size) of Noll 2..modes + 1, blurred by those beyond 120."""
    fine, fidelity = 79, turbulence.fidelity
    step = SAMPLES_PER_LAMBDA_OVER_D / fidelity.lambda_over_d_px
    grid, psfs = pixel_integration_matrix(size, fine, step).float(), []
    for part in coefficients.flatten(0, -2).split(1000):
        stored = fraunhofer_psf(
            part, lambda_over_d_px=SAMPLES_PER_LAMBDA_OVER_D, size=fine, pupil=fine - 3, points=1,
            normalise_plane=True,
        )  # fmt: skip
        blurred = blur_by_unresolved_modes(stored, fidelity.blur_equivalent_d_over_r0, fine)
        psfs.append(grid @ blurred @ grid.T)
    return torch.cat(psfs).reshape(*coefficients.shape[:-1], size, size)


def degrade_with_exact_psfs(
    turbulence: Turbulence, frame: torch.Tensor, generator: torch.Generator, crop: Crop, size: int
) -> torch.Tensor:
    """Return `crop` of a frame (h, w) seen by one view, with exact PSFs at every pixel.

    The turbulence that is drawn is the same; PSFs are `size` pixels across and have no halo.
    """
    exact = copy.copy(turbulence)
    exact.fidelity = replace(turbulence.fidelity, psf_grid_pitch_px=1, psf_size_px=size)
    [plan] = exact.plan(1, generator, crop)
    tables = plan.tables.to(torch.device("cpu"))
    names = "response", "rows", "columns"
    tilt, phase = (
        WaveSum(*(tables[f"{grid}_{name}"] for name in names), first)(plan.amplitudes)
        for grid, first in (("tilt", 0), ("psf", 2))
    )
    rows, columns = plan.psf_grid
    tilt = clip_rendering._interpolate_tilt(plan, tables, tilt)
    warped = blur_torch.warp_cubic(frame[None], tilt, rows.start, columns.start)
    coefficients = functional.pad(phase.permute(1, 2, 3, 0), (2, 0))
    psfs = exact_psfs_of_all_modes(coefficients, turbulence, size).flatten(3).permute(3, 0, 1, 2)
    return blur_torch.scatter_normalised(warped, psfs, rows, torch.zeros(1, *crop[2:]), 0.0)[0]


def short_exposure_blur_std(
    d_over_r0: float, outer_scale_over_d: float, tilt_share: float
) -> float:
    """Return the blur beyond diffraction of von Karman turbulence at the aperture, in lambda / D.

    From the structure function of the phase (Voitsekhovich 1995) less that of the tilt, of whose
    variance the outer scale leaves `tilt_share`.
    """
    nu, order = (np.arange(4000) + 0.5) / 4000, 5 / 6
    near = 2 * math.pi * nu / outer_scale_over_d
    constant = (24 / 5 * special.gamma(6 / 5)) ** order * special.gamma(11 / 6) / math.pi ** (8 / 3)
    reach = special.gamma(order) - 2 ** (1 / 6) * near**order * special.kv(order, near)
    structure = constant * (outer_scale_over_d * d_over_r0) ** (5 / 3) * reach
    exponent = structure / 2 - 3.44 * d_over_r0 ** (5 / 3) * tilt_share * nu**2
    aperture = 2 / math.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    sharp, blurred = (
        _half_light_radius(nu, one) for one in (aperture, aperture * np.exp(-exponent))
    )
    return math.sqrt(blurred**2 - sharp**2) / math.sqrt(2 * math.log(2))


def _half_light_radius(nu: np.ndarray, transfer: np.ndarray) -> float:
    radii = np.geomspace(0.2, 40, 400)
    held = [2 * math.pi * r * float((special.j1(2 * math.pi * r * nu) * transfer).mean())
            for r in radii]  # fmt: skip
    return float(np.interp(0.5, held, radii))
