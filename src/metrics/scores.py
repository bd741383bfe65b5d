"""The scores of a clip: the mean over its frames of every image metric, and its wobble."""

import torch
from jaxtyping import Float
from torch import Tensor

from src.metrics.image import aligned_psnr, psnr, ssim
from src.metrics.lpips import LPIPS
from src.metrics.temporal import wobble


class Scores:
    """PSNR, aligned PSNR, SSIM, LPIPS (if a network is given) and wobble of a clip.

    Values are means of per-frame values; frames are clipped to [0, 1]; the data range is 1.
    """

    def __init__(self, lpips: LPIPS | None = None):
        self.lpips = lpips
        self.names = ["psnr", "psnr_aligned", "ssim", "wobble"] + ["lpips"] * (lpips is not None)

    @torch.no_grad()
    def __call__(
        self, frames: Float[Tensor, "frames 1 h w"], target: Float[Tensor, "frames 1 h w"]
    ) -> dict[str, float]:
        """Return the value of every name in `names`."""
        frames = frames.float().clamp(0, 1)
        values = {
            "psnr": psnr(frames, target),
            "psnr_aligned": aligned_psnr(frames, target),
            "ssim": ssim(frames, target),
            "wobble": wobble(frames, target),
        }
        if self.lpips is not None:
            values["lpips"] = self.lpips.to(frames.device)(frames, target)
        return {name: float(value.mean()) for name, value in values.items()}
