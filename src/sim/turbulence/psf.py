"""Point spread functions: the exact Fraunhofer integral, its resampling, and the halo.

Lengths in the focal plane are in pixels; lambda / D is lambda f / (D p) of them.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float, Int
from scipy.fft import next_fast_len
from torch import Tensor

from src.sim.turbulence.zernike import zernike_basis

CHUNK = 512  # PSFs at a time, so that the fields stay in the cache
SAMPLES_PER_LAMBDA_OVER_D = 2.0  # of stored PSFs: an intensity is band-limited to this


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


def pixel_integration_matrix(size: int, fine: int, step: float) -> Float[Tensor, "size fine"]:
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


class PSFHalo:
    """The light that a point sends beyond its kernel, the same for all points and views.

    The mean PSF (fine, fine) without its `kernel` x `kernel` pixels of
    lambda / D / `lambda_over_d_px` is therefore added once per frame; what that neglects is
    measured by scripts/p2s_errors.py.  `share` of the light of a white scene comes from it.
    """

    def __init__(self, mean: Float[Tensor, "fine fine"], lambda_over_d_px: float, kernel: int):
        widest = int(mean.shape[-1] / SAMPLES_PER_LAMBDA_OVER_D / 2 * lambda_over_d_px)
        reach, step = max(widest, kernel // 2), SAMPLES_PER_LAMBDA_OVER_D / lambda_over_d_px
        grid = pixel_integration_matrix(2 * reach + 1, mean.shape[-1], step).float()
        self.psf = (grid @ (mean / mean.sum()) @ grid.T).clamp(min=0)
        core = slice(reach - kernel // 2, reach + kernel // 2 + 1)
        self.psf[core, core] = 0
        self.reach, self.share = reach, float(self.psf.sum())

    def transform(
        self, frame_size: Sequence[int], window: tuple[int, int, int, int]
    ) -> tuple[Int[Tensor, " rows"], Int[Tensor, " columns"], Complex[Tensor, "rows half"]]:
        """Return the rows and columns of a frame that send light to `window` (top, left, h, w), and
        the transform of the halo there.  A few more rows and columns make a fast size.
        """
        sides = []
        for first, count, pixels in zip(window[:2], window[2:], frame_size, strict=True):
            fast = next_fast_len(count + 2 * self.reach, real=True)
            sides.append(reflect_index(torch.arange(fast) + first - self.reach, pixels))
        psf = self.psf.new_zeros(len(sides[0]), len(sides[1]))
        psf[: len(self.psf), : len(self.psf)] = self.psf
        far = -2 * self.reach  # the first pixel gets light from the sources 0 .. 2 reach
        return sides[0], sides[1], torch.fft.rfft2(psf.roll((far, far), (0, 1)))


def convolve_halo(
    frames: Float[Tensor, "frames height width"],
    rows: Int[Tensor, " rows"],
    columns: Int[Tensor, " columns"],
    spectrum: Complex[Tensor, "rows half"],
    size: Sequence[int],
) -> Float[Tensor, "frames h w"]:
    """Return the halo's light on a window of `size` (h, w), given PSFHalo.transform."""
    sources = frames[:, rows[:, None], columns]
    light = torch.fft.irfft2(torch.fft.rfft2(sources) * spectrum, s=sources.shape[1:])
    return light[:, : size[0], : size[1]].clamp(min=0)


def reflect_index(index: Int[Tensor, "..."], size: int) -> Int[Tensor, "..."]:
    """Return the pixel of the frame whose mirror image lies at `index` (the border is doubled)."""
    folded = torch.remainder(index, 2 * size)
    return torch.minimum(folded, 2 * size - 1 - folded)
