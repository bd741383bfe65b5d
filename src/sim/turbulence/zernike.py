"""Zernike modes of a circular pupil under Kolmogorov turbulence, in Noll's order and scaling.

Coefficients are in rad of phase; mode j has unit RMS over the pupil.  j = 1 is piston, 2 and 3 the
tilts along x and y; x points right, y down, as the columns and rows of an image do.  Noll 1976,
"Zernike polynomials and atmospheric turbulence".
"""

import math
from functools import cache

import numpy as np
import torch
from jaxtyping import Float
from scipy import special
from torch import Tensor

SPECTRUM = 0.022896  # of phase: SPECTRUM r0^(-5/3) f^(-11/3) rad^2 m^2, f in cycles / m


def noll_index(mode: int) -> tuple[int, int]:
    """Return (n, m) of Noll mode `mode` >= 1; m > 0 is a cosine, m < 0 a sine."""
    n = (math.isqrt(8 * mode - 7) - 1) // 2
    place = mode - n * (n + 1) // 2 - 1
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return n, m if mode % 2 == 0 else -m


def pupil_filter(
    kappa: Float[Tensor, " waves"], angle: Float[Tensor, " waves"], modes: int
) -> Float[Tensor, "modes waves 2"]:
    """Return what a plane wave exp(2 pi i f.x) across the pupil gives to Noll modes 2..modes + 1.

    `kappa` = D |f| and the wave's `angle`; real and imaginary part of
    i^n sqrt(n + 1) 2 J_{n+1}(pi kappa) / (pi kappa) {1, sqrt2 cos(m angle), sqrt2 sin(m angle)}
    (Noll 1976, eq. 8, for the phase at the pupil's centre).
    """
    n, m = noll_indices_without_piston(modes)
    x, turn = math.pi * kappa.double().numpy(), angle.double().numpy()
    inside = np.where(x > 0, x, 1)
    bessel = special.jv(np.arange(n[-1] + 2)[:, None], inside) / inside
    radial = 2 * np.sqrt(n + 1)[:, None] * np.where(x > 0, bessel[n + 1], 0)
    azimuth = np.cos(abs(m)[:, None] * turn - np.where(m < 0, math.pi / 2, 0)[:, None])
    scale = np.where(m == 0, 1, math.sqrt(2)) * np.where(np.isin(n % 4, (2, 3)), -1, 1)
    out = np.zeros((modes, len(x), 2))
    out[np.arange(modes), :, n % 2] = scale[:, None] * radial * azimuth
    return torch.from_numpy(out)


@cache
def noll_indices_without_piston(modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Return n and m of Noll modes 2..modes + 1."""
    n, m = np.array([noll_index(mode) for mode in range(2, modes + 2)]).T
    return n, m
