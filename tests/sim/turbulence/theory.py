"""Closed forms and integrals that simulated turbulence is compared with."""

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy import optimize, special
from torch.nn import functional

from scripts.fit_p2s.exact_psf import fraunhofer_psf, noll_covariance
from src.sim import noise
from src.sim.turbulence import clip_rendering
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.coefficient_grid import WaveSum
from src.sim.turbulence.contract import Crop
from src.sim.turbulence.engines import blur_torch
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.p2s import FittedPSFs
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D, pixel_integration_matrix
from src.sim.turbulence.unresolved_blur import blur_by_phase, unresolved_structure_function


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
    """Return exact PSFs (*n, size, size) of Noll 2..modes + 1, blurred by those beyond 120.

    The blur is symmetric: that of a pixel's area gives what the pixel collects of any PSF.
    """
    fine, fidelity = 79, turbulence.fidelity
    step = SAMPLES_PER_LAMBDA_OVER_D / fidelity.lambda_over_d_px
    grid, psfs = pixel_integration_matrix(size, fine, step).float(), []
    beyond = unresolved_structure_function() * fidelity.d_over_r0 ** (5 / 3)
    areas = torch.einsum("iy,jx->ijyx", grid, grid).flatten(0, 1)
    collected = blur_by_phase(areas, beyond, fine).flatten(1).T
    for part in coefficients.flatten(0, -2).split(1000):
        stored = fraunhofer_psf(
            part, lambda_over_d_px=SAMPLES_PER_LAMBDA_OVER_D, size=fine, pupil=fine - 3, points=1,
            normalise_plane=True,
        )  # fmt: skip
        psfs.append(stored.flatten(1) @ collected)
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


def draw_short_exposure_blur(
    d_over_r0: Sequence[float],
    aperture_over_outer_scale: float,
    layers: Sequence[float],
    pupils: int,
) -> list[float]:
    """Return the blur beyond diffraction, no tilt, in lambda / D, of layers at z / L of like Cn2.

    From the mean PSF of `pupils` von Karman phases over 48 x 48 points, drawn by FFT over 8 D (so
    for outer scales up to some D), less the plane fitted to each.
    """
    side, generator = 48, noise.generator(5)
    x = (torch.arange(side) + 0.5) / side * 2 - 1
    inside = torch.hypot(x[:, None], x) <= 1
    down, across = torch.meshgrid(x, x, indexing="ij")
    planes = torch.stack([torch.ones_like(down), down, across])[:, inside]
    planes = torch.linalg.qr(planes.T.double())[0]
    frequency = torch.fft.fftfreq(8 * side, 1 / side, dtype=torch.float64)
    square = frequency[:, None] ** 2 + frequency**2
    share = [(1 - place) ** (5 / 3) for place in layers]
    power = sum(
        part / sum(share) * (square + (aperture_over_outer_scale * (1 - place)) ** 2) ** (-11 / 6)
        for part, place in zip(share, layers, strict=True)
    )
    amplitude = torch.sqrt(0.022896 * torch.as_tensor(power)) / 8 * (8 * side) ** 2
    phases = []
    while 32 * len(phases) < pupils:
        waves = torch.randn(8 * side, 8 * side, dtype=torch.complex128, generator=generator)
        plane = torch.fft.ifft2(waves * math.sqrt(2) * amplitude)
        for part in (plane.real, plane.imag):
            tiles = part.unfold(0, side, 2 * side).unfold(1, side, 2 * side).flatten(0, 1)
            phases.append(tiles[:, inside])
    phase = torch.cat(phases)
    phase = phase - phase @ planes @ planes.T
    radii = [_half_light_radius(phase * d ** (5 / 6), inside) for d in (0.0, *d_over_r0)]
    return [math.sqrt(one**2 - radii[0] ** 2) / math.sqrt(2 * math.log(2)) for one in radii[1:]]


def _half_light_radius(phase: torch.Tensor, inside: torch.Tensor) -> float:
    count = 256
    field = torch.zeros(len(phase), *inside.shape, dtype=torch.complex64)
    field[:, inside] = torch.exp(1j * phase).to(torch.complex64)
    light = torch.zeros(count, count)
    for part in field.split(64):
        light += torch.fft.fft2(part, s=(count, count)).abs().square().sum(0)
    transfer = torch.fft.ifft2(light / light.sum()).real * count**2
    nu = torch.fft.fftfreq(count, 1 / count).abs() / len(inside)
    distance = torch.hypot(nu[:, None], nu).flatten()
    order = (distance < 1).nonzero()[:, 0]
    radii = torch.logspace(-0.7, 1.3, 300)
    turns = 2 * math.pi * radii[:, None] * distance[order]
    cell = 1 / len(inside) ** 2  # of the plane of nu
    weight = special.j1(turns.numpy()) / distance[order].clamp(min=1e-6).numpy()
    held = radii.numpy() * (weight * transfer.flatten()[order].numpy()).sum(1) * cell
    held += radii.numpy() ** 2 * math.pi * cell  # nu = 0, where J1(x) / nu is pi r
    return float(np.interp(0.5, held, radii.numpy()))
