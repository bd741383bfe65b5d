"""Scores of single frames.  Pictures (n, 1, h, w) on [0, 1], data range 1; one value per frame."""

import kornia.metrics
import torch
from jaxtyping import Float
from torch import Tensor, nn


class L1(nn.Module):
    """Mean absolute error of each frame, as a training loss: unclipped."""

    def forward(
        self, prediction: Float[Tensor, "n c h w"], target: Float[Tensor, "n c h w"]
    ) -> Float[Tensor, " n"]:
        """Return one value per frame."""
        return (prediction - target).abs().mean((1, 2, 3))


def psnr(
    prediction: Float[Tensor, "n 1 h w"], target: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, " n"]:
    """Return 10 log10(1 / MSE) in dB, the prediction clipped to [0, 1], at most 100 dB."""
    error = (prediction.clamp(0, 1) - target).square().mean((1, 2, 3))
    return -10 * torch.log10(error.clamp(min=1e-10))


def aligned_psnr(
    prediction: Float[Tensor, "n 1 h w"], target: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, " n"]:
    """Return the PSNR after the least-squares gain (>= 0) and offset of each frame."""
    x, y = prediction.flatten(1), target.flatten(1)
    centred = x - x.mean(1, keepdim=True)
    gain = (centred * y).mean(1, keepdim=True) / centred.square().mean(1, keepdim=True).clamp(1e-12)
    fitted = gain.clamp(min=0) * centred + y.mean(1, keepdim=True)
    return psnr(fitted.view_as(prediction), target)


def ssim(
    prediction: Float[Tensor, "n 1 h w"], target: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, " n"]:
    """Return the structural similarity (Wang et al. 2004), the prediction clipped to [0, 1].

    Gaussian window of 11 pixels and standard deviation 1.5, population covariance, mean over the
    places where the window lies inside the frame, as scikit-image has it.
    """
    values = kornia.metrics.ssim(prediction.clamp(0, 1), target, 11, padding="valid")
    return values.mean((1, 2, 3))
