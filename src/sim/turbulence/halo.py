"""The halo: the light that a point sends beyond its kernel, the same for all points and views.

Far from its core a PSF is mean diffraction with faint speckle, and so smooth that a pixel's tilt
hardly moves it.  The mean is therefore added once per frame, and a kernel need only hold what
changes from point to point; what that neglects is measured by scripts/p2s_errors.py.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Complex, Float, Int
from scipy.fft import next_fast_len
from torch import Tensor

from src.sim.turbulence.engines.blur_eager import reflect
from src.sim.turbulence.p2s import FINE_PER_AIRY
from src.sim.turbulence.psf import resampling


class Halo:
    """The mean PSF (fine, fine), on pixels of lambda / D / `airy_px`, without its `kernel` pixels.

    `share` of the light of a white scene comes from it.
    """

    def __init__(self, mean: Float[Tensor, "fine fine"], airy_px: float, kernel: int):
        reach = max(int(mean.shape[-1] / FINE_PER_AIRY / 2 * airy_px), kernel // 2)
        grid = resampling(2 * reach + 1, mean.shape[-1], FINE_PER_AIRY / airy_px).float()
        self.shape = (grid @ (mean / mean.sum()) @ grid.T).clamp(min=0)
        core = slice(reach - kernel // 2, reach + kernel // 2 + 1)
        self.shape[core, core] = 0
        self.reach, self.share = reach, float(self.shape.sum())

    def __call__(
        self, frames: Float[Tensor, "frames height width"], top: int, left: int, h: int, w: int
    ) -> Float[Tensor, "frames h w"]:
        """Return the light it gives to the `h` x `w` pixels from (`top`, `left`) on.

        Outside the frame lies its reflection.
        """
        if self.share == 0:
            return frames.new_zeros(len(frames), h, w)
        return halo_light(frames, *self.tables(frames.shape[-2:], top, left, h, w), h, w)

    def tables(
        self, size: Sequence[int], top: int, left: int, h: int, w: int
    ) -> tuple[Int[Tensor, " rows"], Int[Tensor, " columns"], Complex[Tensor, "rows half"]]:
        """Return the rows and columns of frames of `size` that light comes from, and the transform
        of the shape.  A few rows and columns more make numbers of them that transform fast.
        """
        sides = []
        for first, count, pixels in zip((top, left), (h, w), size, strict=True):
            fast = next_fast_len(count + 2 * self.reach, real=True)
            sides.append(reflect(torch.arange(fast) + first - self.reach, pixels))
        shape = self.shape.new_zeros(*map(len, sides))
        shape[: len(self.shape), : len(self.shape)] = self.shape
        far = -2 * self.reach  # the first pixel gets light from the sources 0 .. 2 reach
        return *sides, torch.fft.rfft2(shape.roll((far, far), (0, 1)))


def halo_light(
    frames: Float[Tensor, "frames height width"],
    rows: Int[Tensor, " rows"],
    columns: Int[Tensor, " columns"],
    spectrum: Complex[Tensor, "rows half"],
    h: int,
    w: int,
) -> Float[Tensor, "frames h w"]:
    """Return the light by Halo.tables, on the device where these are."""
    around = frames[:, rows[:, None], columns]
    light = torch.fft.irfft2(torch.fft.rfft2(around) * spectrum, s=around.shape[1:])
    return light[:, :h, :w].clamp(min=0)
