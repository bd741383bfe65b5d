"""Exact point spread functions and the statistics of Zernike modes: what p2s.py is fitted to.

Conventions are those of src/sim/turbulence/zernike.py and psf.py.
"""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy import special
from torch import Tensor

from src.sim.turbulence.zernike import noll_index, noll_indices_without_piston

CHUNK = 512  # PSFs at a time, so that the fields stay in the cache
COVARIANCE = 2.246061  # Noll's 2.2424 without the rounding of his 0.023


def fraunhofer_psf(
    coefficients: Float[Tensor, "*n modes"],
    *,
    lambda_over_d_px: float,
    size: int,
    pupil: int = 0,
    points: int = 0,
    normalise_plane: bool = False,
) -> Float[Tensor, "*n size size"]:
    """Return |Fourier transform of P exp(i phi)|^2 integrated over pixels; each sums to 1.

    `coefficients` are Noll 2..modes + 1 in rad, `size` is odd, the axis of the camera falls on the
    middle pixel and a positive a2 moves the light to larger columns.  `pupil`: samples across the
    pupil (0: enough for `size`); `points`: samples per pixel and axis (0: enough for its integral;
    1: the value at its centre).  With `normalise_plane` the light of the endless plane sums to 1,
    of which the pixels hold a part.  Goodman, Introduction to Fourier Optics, 5.2.
    """
    if size % 2 == 0 or size < 1 or not lambda_over_d_px > 0:
        raise ValueError(
            f"psf needs an odd size and lambda_over_d_px > 0, got {size}, {lambda_over_d_px}"
        )
    pupil = pupil or max(24, math.ceil(1.5 * size / lambda_over_d_px) + 8)
    points = points or max(1, math.ceil(5 / lambda_over_d_px))
    flat = coefficients.reshape(-1, coefficients.shape[-1])
    values, places = zernike_basis(flat.shape[-1], pupil)
    column, row = ((places + 1) * pupil / 2).long().unbind(-1)
    xi = (torch.arange(pupil, dtype=torch.float64) + 0.5) / pupil - 0.5
    x = (torch.arange(size * points, dtype=torch.float64) + 0.5) / points - size / 2
    turn = torch.exp(-2j * math.pi * xi[:, None] * x / lambda_over_d_px)
    turn, psfs = turn.to(flat.device, flat.dtype.to_complex()), []
    for part in flat.split(CHUNK):
        wave = turn.new_zeros(len(part), pupil, pupil)
        wave[:, row, column] = torch.exp(1j * (part @ values.to(part)))
        light = (turn.T @ wave @ turn).abs().square()
        psfs.append(light.reshape(-1, size, points, size, points).sum((2, 4)))
    psf = torch.cat(psfs)
    if normalise_plane:  # Parseval
        psf /= len(places) * (pupil * lambda_over_d_px * points) ** 2
    else:
        psf /= psf.sum((1, 2), keepdim=True)
    return psf.reshape(*coefficients.shape[:-1], size, size)


def noll_covariance(modes: int) -> Float[Tensor, "modes modes"]:
    """Return the covariance of Noll coefficients 2..modes + 1 at D/r0 = 1, in rad^2, float64
    (Noll 1976, eq. 25); it scales with (D/r0)^(5/3)."""
    n, m = noll_indices_without_piston(modes)
    total, apart, third = n[:, None] + n, n[:, None] - n, 17 / 3
    signs = (-1.0) ** (total // 2 - abs(m))
    signs *= special.gammasgn((apart + third) / 2) * special.gammasgn((third - apart) / 2)
    logs = special.gammaln((total - 5 / 3) / 2) - special.gammaln((total + 23 / 3) / 2)
    logs -= special.gammaln((apart + third) / 2) + special.gammaln((third - apart) / 2)
    scale = COVARIANCE * np.sqrt(np.multiply.outer(n + 1, n + 1))
    return torch.from_numpy(np.where(m[:, None] == m, signs * scale * np.exp(logs), 0))


def zernike_basis(modes: int, size: int) -> tuple[Float[Tensor, "modes p"], Float[Tensor, "p 2"]]:
    """Return Noll modes 2..modes + 1 at the points of a `size` x `size` grid inside the unit disc.

    Also the (x, y) of the points, in pupil radii.
    """
    axis = (torch.arange(size, dtype=torch.float64) + 0.5) * 2 / size - 1
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    inside = x**2 + y**2 <= 1
    points = torch.stack([x[inside], y[inside]], dim=-1)
    radius, angle = points.norm(dim=-1), torch.atan2(points[:, 1], points[:, 0])
    return torch.stack([_mode(noll_index(j), radius, angle) for j in range(2, modes + 2)]), points


def _mode(index: tuple[int, int], radius: Tensor, angle: Tensor) -> Tensor:
    n, m = index[0], abs(index[1])
    total = torch.zeros_like(radius)
    for s in range((n - m) // 2 + 1):
        weight = (-1) ** s * math.comb(n - s, s) * math.comb(n - 2 * s, (n - m) // 2 - s)
        total = total + weight * radius ** (n - 2 * s)
    azimuth = torch.sin(m * angle) if index[1] < 0 else torch.cos(m * angle)
    return math.sqrt((n + 1) * (2 if m else 1)) * total * azimuth
