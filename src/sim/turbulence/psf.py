"""From phase to point spread function: the exact Fraunhofer integral, and its resampling.

Lengths in the focal plane are in pixels; lambda / D is `airy_px` pixels (lambda f / (D p)).
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.sim.turbulence.zernike import zernike_basis

CHUNK = 512  # PSFs at a time, so that the fields stay in the cache


def fraunhofer_psf(
    coefficients: Float[Tensor, "*n modes"],
    *,
    airy_px: float,
    size: int,
    pupil: int = 0,
    points: int = 0,
    whole: bool = False,
) -> Float[Tensor, "*n size size"]:
    """Return |Fourier transform of P exp(i phi)|^2 integrated over pixels; each sums to 1.

    `coefficients` are Noll 2..modes + 1 in rad, `size` is odd, the axis of the camera falls on the
    middle pixel and a positive a2 moves the light to larger columns.  `pupil`: samples across the
    pupil (0: enough for `size`); `points`: samples per pixel and axis (0: enough for its integral;
    1: the value at its centre).  With `whole` it is the light of the endless plane that sums to 1,
    of which the pixels hold a part.  Goodman, Introduction to Fourier Optics, 5.2.
    """
    if size % 2 == 0 or size < 1 or not airy_px > 0:
        raise ValueError(f"psf needs an odd size and airy_px > 0, got {size}, {airy_px}")
    pupil = pupil or max(24, math.ceil(1.5 * size / airy_px) + 8)
    points = points or max(1, math.ceil(5 / airy_px))
    flat = coefficients.reshape(-1, coefficients.shape[-1])
    inside, basis = _pupil(flat.shape[-1], pupil)
    inside, basis = inside.to(flat), basis.to(flat)
    turn = _transform(pupil, size * points, airy_px * points).to(flat)
    spots = torch.cat([_spot(part @ basis, inside, turn, size) for part in flat.split(CHUNK)])
    if whole:  # Parseval
        spots /= inside.sum() * (pupil * airy_px * points) ** 2
    else:
        spots /= spots.sum((1, 2), keepdim=True)
    return spots.reshape(*coefficients.shape[:-1], size, size)


def exact_spots(
    phase: Float[Tensor, "blurmodes n rows columns"], airy_px: float, size: int
) -> Float[Tensor, "pixels n rows columns"]:
    """Return the PSFs of Noll 4, 5, ... at nodes, pixel by pixel; the light of the plane is 1."""
    flat = functional.pad(phase.permute(1, 2, 3, 0), (2, 0))
    psf = fraunhofer_psf(flat, airy_px=airy_px, size=size, whole=True)
    return psf.flatten(3).permute(3, 0, 1, 2).contiguous()


def resampling(size: int, fine: int, step: float) -> Float[Tensor, "size fine"]:
    """Return the integrals over `size` pixels of a function known at `fine` samples, per axis.

    Both odd and centred; a pixel is `step` samples wide.  The function is taken for band-limited,
    which a PSF sampled twice per lambda / D is, so that this is exact but for the ends.
    """
    count = 4 * fine
    frequency = torch.fft.fftfreq(count, dtype=torch.float64)
    pixel = (torch.arange(size, dtype=torch.float64) - size // 2) * step
    sample = torch.arange(fine, dtype=torch.float64) - fine // 2
    distance = pixel[:, None] - sample
    weight = torch.sinc(frequency * step) * step / count
    return torch.cos(2 * math.pi * distance[..., None] * frequency) @ weight


def _spot(phase: Tensor, inside: Tensor, turn: Tensor, size: int) -> Tensor:
    """Return the intensity (n, size, size) of pupil phases (n, samples^2)."""
    samples, fine = turn.shape[0] // 2, turn.shape[1] // 2
    wave = torch.stack([phase.cos() * inside, phase.sin() * inside], dim=1)
    rows = wave.reshape(-1, 2, samples, samples).transpose(1, 2)
    across = rows.reshape(-1, 2 * samples) @ turn
    columns = across.reshape(-1, samples, 2, fine).permute(0, 3, 2, 1)
    field = columns.reshape(-1, 2 * samples) @ turn
    light = field.square().reshape(-1, fine, 2, fine).sum(2).transpose(1, 2)
    points = fine // size
    if points > 1:
        light = light.reshape(-1, size, points, size, points).sum((2, 4))
    return light


def _pupil(modes: int, samples: int) -> tuple[Tensor, Tensor]:
    """Return the aperture (samples^2,) and the modes on it (modes, samples^2), zero outside."""
    values, points = zernike_basis(modes, samples)
    column, row = ((points + 1) * samples / 2).long().unbind(-1)
    inside = torch.zeros(samples * samples, dtype=torch.float64)
    inside[row * samples + column] = 1
    basis = torch.zeros(modes, samples * samples, dtype=torch.float64)
    basis[:, row * samples + column] = values
    return inside, basis


def _transform(samples: int, count: int, airy: float) -> Tensor:
    """Return exp(-2 pi i x xi) for `count` points of the focal plane as a real matrix.

    (2 samples, 2 count): real and imaginary part in, real and imaginary part out.
    """
    xi = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
    x = (torch.arange(count, dtype=torch.float64) + 0.5 - count / 2) / airy
    angle = 2 * math.pi * xi[:, None] * x
    cos, sin = angle.cos(), angle.sin()
    return torch.cat([torch.cat([cos, -sin], 1), torch.cat([sin, cos], 1)])
