"""The scores of a clip: the mean over its frames of every image metric, and its wobble."""

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.metrics.image import aligned_psnr, psnr, ssim
from src.metrics.lpips import LPIPS
from src.metrics.temporal import wobble

MEASURES = {  # name in table.py: a value per frame, or per step from a frame to the next
    "psnr": psnr,
    "psnr_aligned": aligned_psnr,
    "ssim": ssim,
    "wobble": wobble,
}


class Scores:
    """PSNR, aligned PSNR, SSIM, LPIPS (if a network is given) and wobble of a clip.

    Values are means of per-frame values; frames are clipped to [0, 1]; the data range is 1.
    `scale`: frames and targets are scored at so many times their own resolution, wobble in pixels
    of the scored picture.  Whole numbers repeat pixels, so that PSNR stays; below 1 areas are
    averaged.
    """

    def __init__(self, lpips: LPIPS | None = None, scale: float = 1.0):
        if not 0 < scale <= 8 or (scale > 1 and scale != int(scale)):
            raise ValueError(f"metrics.scale must be in (0, 1] or one of 2..8, got {scale}")
        self.lpips, self.scale = lpips, scale
        self.names = [*MEASURES] + ["lpips"] * (lpips is not None)

    @torch.no_grad()
    def __call__(
        self, frames: Float[Tensor, "frames 1 h w"], target: Float[Tensor, "frames 1 h w"]
    ) -> dict[str, float]:
        """Return the value of every name in `names`."""
        frames = self._resample(frames.float().clamp(0, 1))
        target = self._resample(target)
        values = {name: measure(frames, target) for name, measure in MEASURES.items()}
        if self.lpips is not None:
            values["lpips"] = self.lpips.to(frames.device)(frames, target)
        return {name: float(value.mean()) for name, value in values.items()}

    def _resample(self, frames: Tensor) -> Tensor:
        if self.scale == 1:
            return frames
        size = [math.floor(side * self.scale + 0.5) for side in frames.shape[-2:]]
        mode = "nearest" if self.scale > 1 else "area"
        return functional.interpolate(frames, size, mode=mode)
