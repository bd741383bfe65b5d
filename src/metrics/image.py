"""Scores of single frames.  Pictures (n, 1, h, w) on [0, 1], data range 1; one value per frame."""

import functools

import torch
from jaxtyping import Float
from torch import Tensor, nn

WINDOW, SIGMA = 11, 1.5  # of SSIM: pixels
C1, C2 = 0.01**2, 0.03**2


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
    """Return the PSNR of each frame once it is `aligned`."""
    return psnr(aligned(prediction, target), target)


def aligned(
    prediction: Float[Tensor, "n 1 h w"], target: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, "n 1 h w"]:
    """Return each frame after the gain (>= 0) and offset that fit it best, by least squares."""
    x, y = prediction.flatten(1), target.flatten(1)
    centred = x - x.mean(1, keepdim=True)
    gain = (centred * y).mean(1, keepdim=True) / centred.square().mean(1, keepdim=True).clamp(1e-12)
    fitted = gain.clamp(min=0) * centred + y.mean(1, keepdim=True)
    return fitted.view_as(prediction)


def ssim(
    prediction: Float[Tensor, "n 1 h w"], target: Float[Tensor, "n 1 h w"]
) -> Float[Tensor, " n"]:
    """Return the structural similarity (Wang et al. 2004), the prediction clipped to [0, 1].

    Gaussian window of 11 pixels and standard deviation 1.5, population covariance, mean over the
    places where the window lies inside the frame, as scikit-image has it.  Raises ValueError for
    frames smaller than the window.
    """
    x, y = prediction.float().clamp(0, 1), target.float()
    with torch.autocast(x.device.type, enabled=False):
        seen = [_windowed(part) for part in (x, y, x * x, y * y, x * y)]
    mean_x, mean_y, square_x, square_y, product = seen
    both, squares = mean_x * mean_y, mean_x.square() + mean_y.square()
    alike = (2 * both + C1) * (2 * (product - both) + C2)
    most = (squares + C1) * (square_x + square_y - squares + C2)
    return (alike / most).mean((1, 2, 3))


def _windowed(x: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 hv wv"]:
    """Return the weighted means over the windows inside the frame, as products of matrices: their
    gradient takes a ninth of the time of a convolution's on a CPU.
    """
    rows, columns = (_bands(size, x.device) for size in x.shape[-2:])
    return rows @ x @ columns.T


@functools.lru_cache(maxsize=32)
@torch.inference_mode(False)
def _bands(size: int, device: torch.device) -> Float[Tensor, "windows size"]:
    """Return the weights of every window that lies inside `size` pixels, a row each."""
    if size < WINDOW:
        raise ValueError(f"SSIM needs frames of at least {WINDOW} pixels a side, got {size}")
    weight = torch.exp(-((torch.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    places = torch.arange(size - WINDOW + 1)[:, None] + torch.arange(WINDOW)
    bands = torch.zeros(len(places), size)
    return bands.scatter_(1, places, (weight / weight.sum()).expand_as(places).clone()).to(device)
