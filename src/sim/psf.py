"""From phase to point spread function: the exact Fraunhofer integral.

Lengths in the focal plane are in pixels; lambda / D is `airy_px` pixels (lambda f / (D p)).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.zernike import zernike_basis


def fraunhofer_psf(
    coefficients: Float[Tensor, "*n modes"], *, airy_px: float, size: int, pupil: int = 0
) -> Float[Tensor, "*n size size"]:
    """Return |Fourier transform of P exp(i phi)|^2 integrated over pixels; each sums to 1.

    `coefficients` are Noll 2..modes + 1 in rad, `size` is odd, the axis of the camera falls on the
    middle pixel and a positive a2 moves the light to larger columns.  `pupil` is the number of
    samples across the pupil (0: enough for `size`).  Goodman, Introduction to Fourier Optics, 5.2.
    """
    if size % 2 == 0 or airy_px <= 0:
        raise ValueError(f"psf needs an odd size and airy_px > 0, got {size}, {airy_px}")
    samples = pupil or max(24, math.ceil(1.5 * size / airy_px))
    basis, points = zernike_basis(coefficients.shape[-1], samples)
    flat = coefficients.reshape(-1, coefficients.shape[-1])
    phase = flat @ basis.to(flat)
    wave = torch.zeros(len(flat), samples * samples, dtype=phase.to(torch.complex64).dtype)
    wave = wave.to(flat.device)
    column, row = ((points + 1) * samples / 2).floor().long().to(flat.device).unbind(-1)
    wave[:, row * samples + column] = torch.polar(torch.ones_like(phase), phase)
    kernel = _transform(samples, size, airy_px).to(wave)
    field = kernel @ wave.reshape(-1, samples, samples) @ kernel.T
    fine = field.real**2 + field.imag**2
    over = fine.shape[-1] // size
    psf = fine.reshape(-1, size, over, size, over).sum((2, 4))
    psf = psf / psf.sum((1, 2), keepdim=True)
    return psf.reshape(*coefficients.shape[:-1], size, size)


def _transform(samples: int, size: int, airy_px: float) -> Tensor:
    """Return exp(-2 pi i x xi), (size * over, samples): enough points a pixel for its integral."""
    over = max(1, math.ceil(3 / airy_px))
    xi = ((torch.arange(samples, dtype=torch.float64) + 0.5) / samples) - 0.5
    pixels = (torch.arange(size * over, dtype=torch.float64) + 0.5) / over - size / 2
    return torch.exp(-2j * math.pi * pixels[:, None] / airy_px * xi[None])
