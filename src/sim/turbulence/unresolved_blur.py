"""The blur of Zernike modes that the fitted PSFs hold none of, the same for every PSF.

Phase of high order is correlated over far less than the pupil, so that the mean transfer function
is that of the lower orders times exp(-S(nu) / 2) (Goodman, Statistical Optics, ch. 8), S its
structure function for points of the pupil nu D apart.  Its spectrum is that of von Karman phase less
what the lower Zernike orders hold of it (Noll 1976).
"""  # noqa: E501

import math
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy import special
from scipy.fft import next_fast_len
from torch import Tensor

from src.sim.turbulence import outer_scale
from src.sim.turbulence.outer_scale import KAPPA0, Cn2Profile
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D
from src.sim.turbulence.zernike import SPECTRUM, noll_index

StructureFunction = Float[np.ndarray, " distances"]  # at DISTANCES, in rad^2

HIGHEST_ORDER = 14  # of Noll modes 2..120, which PSFs are fitted to
KAPPA = np.geomspace(0.01, 3000, 6000)  # cycles per pupil
DISTANCES = np.linspace(0, math.sqrt(2), 400)  # of points of the pupil, in D


def blur_by_phase(
    psfs: Float[Tensor, "*n fine fine"], structure: StructureFunction, size: int
) -> Float[Tensor, "*n size size"]:
    """Return PSFs, sampled as the stored ones, blurred by phase of that structure function.

    The light of a PSF is kept; what falls outside of `size` samples is lost.
    """
    fine = psfs.shape[-1]
    count = next_fast_len(2 * max(size, fine), real=True)
    nu = torch.fft.fftfreq(count, dtype=torch.float64) * SAMPLES_PER_LAMBDA_OVER_D
    distance = torch.hypot(nu[:, None], nu[: count // 2 + 1])
    transfer = torch.from_numpy(np.exp(-np.interp(distance.numpy(), DISTANCES, structure) / 2))
    spectrum = torch.fft.rfft2(psfs, s=(count, count)) * transfer.to(psfs)
    middle = size // 2 - fine // 2
    blurred = torch.fft.irfft2(spectrum, s=(count, count)).roll((middle, middle), (-2, -1))
    return blurred[..., :size, :size]


def missing_structure_function(
    input_modes: int,
    d_over_r0: float,
    blur_equivalent_d_over_r0: float,
    aperture_over_outer_scale: float,
    profile: Cn2Profile,
) -> StructureFunction:
    """Return the structure function of the phase that a network's PSFs are without.

    A network that sees `input_modes` modes from tilt on, of whole Zernike orders, blurs by those up
    to HIGHEST_ORDER as Kolmogorov turbulence of `blur_equivalent_d_over_r0` does; where that is
    more than there is, none is missing.
    """
    order = noll_index(input_modes + 1)[0]
    unseen = unresolved_structure_function(order, aperture_over_outer_scale, profile)
    fitted = unresolved_structure_function(order) - unresolved_structure_function(HIGHEST_ORDER)
    missing = unseen * d_over_r0 ** (5 / 3) - fitted * blur_equivalent_d_over_r0 ** (5 / 3)
    return np.maximum(missing, 0)


def unresolved_structure_function(
    order: int = HIGHEST_ORDER,
    aperture_over_outer_scale: float = 0.0,
    profile: Cn2Profile = (1.0,),
) -> StructureFunction:
    """Return the structure function of Zernike orders beyond `order` at D/r0 = 1."""
    table = _structure_functions(order)
    return outer_scale.average_over_path(table, aperture_over_outer_scale, profile)


@cache
def _structure_functions(order: int) -> Float[np.ndarray, "scales distances"]:
    """Return those of orders beyond `order` at DISTANCES for the outer scales D / KAPPA0."""
    power = SPECTRUM * (KAPPA**2 + KAPPA0[:, None] ** 2) ** (-11 / 6)
    step = math.log(KAPPA[1] / KAPPA[0])
    resolved = sum(
        (n + 1) ** 2 * (2 * special.jv(n + 1, math.pi * KAPPA) / (math.pi * KAPPA)) ** 2
        for n in range(order + 1)
    )
    left = np.maximum(1 - resolved, 0) * power * 2 * math.pi * KAPPA**2 * step
    return left @ _waves_between_points()


@cache
def _waves_between_points() -> Float[np.ndarray, "kappa distances"]:
    """Return what a wave of unit power adds to the structure function, mean over directions."""
    return 2 * (1 - special.j0(2 * math.pi * np.multiply.outer(KAPPA, DISTANCES)))
