"""The blur of Zernike modes beyond those that PSFs are fitted to, the same for every PSF.

Their phase is correlated over far less than the pupil, so that the mean transfer function is that
of the lower modes times exp(-D(nu) / 2) (Goodman, Statistical Optics, ch. 8), D their structure
function for points of the pupil nu D apart.  Its spectrum is that of Kolmogorov phase less what
Zernike orders 0..HIGHEST_ORDER hold of it (Noll 1976).
"""

import math
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy import special
from scipy.fft import next_fast_len
from torch import Tensor

from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D
from src.sim.turbulence.zernike import SPECTRUM

HIGHEST_ORDER = 14  # of Noll modes 2..120
KAPPA = np.geomspace(0.01, 3000, 6000)  # cycles per pupil
DISTANCES = np.linspace(0, math.sqrt(2), 400)  # of points of the pupil, in D


def blur_by_unresolved_modes(
    psfs: Float[Tensor, "*n fine fine"], d_over_r0: float, size: int
) -> Float[Tensor, "*n size size"]:
    """Return PSFs of Noll modes 2..120, sampled as the stored ones, blurred by all beyond.

    The light of a PSF is kept; what falls outside of `size` samples is lost.
    """
    fine = psfs.shape[-1]
    count = next_fast_len(2 * max(size, fine), real=True)
    nu = torch.fft.fftfreq(count, dtype=torch.float64) * SAMPLES_PER_LAMBDA_OVER_D
    distance = torch.hypot(nu[:, None], nu[: count // 2 + 1])
    structure = np.interp(distance.numpy(), DISTANCES, unresolved_structure_function())
    transfer = torch.from_numpy(np.exp(-structure / 2 * d_over_r0 ** (5 / 3)))
    spectrum = torch.fft.rfft2(psfs, s=(count, count)) * transfer.to(psfs)
    middle = size // 2 - fine // 2
    blurred = torch.fft.irfft2(spectrum, s=(count, count)).roll((middle, middle), (-2, -1))
    return blurred[..., :size, :size]


@cache
def unresolved_structure_function() -> Float[np.ndarray, " distances"]:
    """Return the structure function of the modes beyond, at D/r0 = 1 and DISTANCES, in rad^2."""
    power, step = SPECTRUM * KAPPA ** (-11 / 3), math.log(KAPPA[1] / KAPPA[0])
    resolved = sum(
        (order + 1) ** 2 * (2 * special.jv(order + 1, math.pi * KAPPA) / (math.pi * KAPPA)) ** 2
        for order in range(HIGHEST_ORDER + 1)
    )
    left = np.maximum(1 - resolved, 0) * power * 2 * math.pi * KAPPA**2 * step
    return 2 * (1 - special.j0(2 * math.pi * np.multiply.outer(DISTANCES, KAPPA))) @ left
