"""The halo: the light that a point sends beyond its kernel, the same for all points and views.

Far from its core a PSF is mean diffraction with faint speckle, and so smooth that a pixel's tilt
hardly moves it.  The mean is therefore added once per frame, and a kernel need only hold what
changes from point to point; what that neglects is measured by scripts/p2s_errors.py.
"""

import torch
from jaxtyping import Float
from scipy.fft import next_fast_len
from torch import Tensor

from src.sim.turbulence.blur import reflect
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
        sides = [
            reflect(torch.arange(first - self.reach, first + count + self.reach), size)
            for first, count, size in zip((top, left), (h, w), frames.shape[-2:], strict=True)
        ]
        rows, columns = (side.to(frames.device) for side in sides)
        around = frames[:, rows][:, :, columns]
        size = [next_fast_len(len(side), real=True) for side in sides]
        spectrum = torch.fft.rfft2(self.shape.to(frames), s=size)
        light = torch.fft.irfft2(torch.fft.rfft2(around, s=size) * spectrum, s=size)
        far = 2 * self.reach
        return light[:, far : far + h, far : far + w].clamp(min=0)
