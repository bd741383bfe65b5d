"""Point spread functions: their resampling to pixels, and the halo.

Lengths in the focal plane are in pixels; lambda / D is lambda f / (D p) of them.
"""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float, Int
from scipy.fft import next_fast_len
from torch import Tensor

SAMPLES_PER_LAMBDA_OVER_D = 2.0  # of stored PSFs: an intensity is band-limited to this


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

    The mean PSF (fine, fine), whose light is 1, without its `kernel` x `kernel` pixels of
    lambda / D / `lambda_over_d_px`; `share` of the light of a white scene comes from it.
    """

    def __init__(self, mean: Float[Tensor, "fine fine"], lambda_over_d_px: float, kernel: int):
        widest = int(mean.shape[-1] / SAMPLES_PER_LAMBDA_OVER_D / 2 * lambda_over_d_px)
        reach, step = max(widest, kernel // 2), SAMPLES_PER_LAMBDA_OVER_D / lambda_over_d_px
        grid = pixel_integration_matrix(2 * reach + 1, mean.shape[-1], step).float()
        self.psf = (grid @ mean @ grid.T).clamp(min=0)
        core = slice(reach - kernel // 2, reach + kernel // 2 + 1)
        self.psf[core, core] = 0
        self.reach, self.share = reach, float(self.psf.sum())

    def sources_and_spectrum(
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
    source_rows: Int[Tensor, " rows"],
    source_columns: Int[Tensor, " columns"],
    spectrum: Complex[Tensor, "rows half"],
    size: Sequence[int],
) -> Float[Tensor, "frames h w"]:
    """Return the halo's light on a window of `size` (h, w), given PSFHalo.sources_and_spectrum."""
    sources = frames[:, source_rows[:, None], source_columns]
    light = torch.fft.irfft2(torch.fft.rfft2(sources) * spectrum, s=sources.shape[1:])
    return light[:, : size[0], : size[1]].clamp(min=0)


def reflect_index(index: Int[Tensor, "..."], size: int) -> Int[Tensor, "..."]:
    """Return the pixel of the frame whose mirror image lies at `index` (the border is doubled)."""
    folded = torch.remainder(index, 2 * size)
    return torch.minimum(folded, 2 * size - 1 - folded)
