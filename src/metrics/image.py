"""Scores of single frames.  Pictures (n, 1, h, w) on [0, 1], data range 1; one value per frame."""

import functools

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio

Frames = Float[Tensor, "n 1 h w"]
FrameValues = Float[Tensor, " n"]

WINDOW, SIGMA = 11, 1.5  # of SSIM: pixels
C1, C2 = 0.01**2, 0.03**2
LARGEST_PSNR = 100.0  # dB, of equal frames, so that means stay finite


def psnr(prediction: Frames, target: Frames) -> FrameValues:
    """Return 10 log10(1 / MSE) in dB, the prediction clipped to [0, 1], at most 100 dB."""
    value = peak_signal_noise_ratio(
        prediction.clamp(0, 1), target, data_range=1.0, dim=(1, 2, 3), reduction="none"
    )
    return value.clamp(max=LARGEST_PSNR)


def aligned_psnr(prediction: Frames, target: Frames) -> FrameValues:
    """Return the PSNR of each frame after `align_brightness`."""
    return psnr(align_brightness(prediction, target), target)


def align_brightness(prediction: Frames, target: Frames) -> Frames:
    """Return each frame after the gain (>= 0) and offset that fit it best, by least squares."""
    x, y = prediction.flatten(1), target.flatten(1)
    centred = x - x.mean(1, keepdim=True)
    gain = (centred * y).mean(1, keepdim=True) / centred.square().mean(1, keepdim=True).clamp(1e-12)
    fitted = gain.clamp(min=0) * centred + y.mean(1, keepdim=True)
    return fitted.view_as(prediction)


def ssim(prediction: Frames, target: Frames) -> FrameValues:
    """Return the structural similarity (Wang et al. 2004), the prediction clipped to [0, 1].

    Gaussian window of 11 pixels and standard deviation 1.5, population covariance, mean over the
    windows inside the frame, as scikit-image (torchmetrics differs by up to 1e-3 and takes 14 times
    as long).  Raises ValueError for frames smaller than the window.
    """
    x, y = prediction.float().clamp(0, 1), target.float()
    with torch.autocast(x.device.type, enabled=False):
        sums = [_window_means(part) for part in (x, y, x * x, y * y, x * y)]
    mean_x, mean_y, square_x, square_y, product = sums
    cross, squares = mean_x * mean_y, mean_x.square() + mean_y.square()
    numerator = (2 * cross + C1) * (2 * (product - cross) + C2)
    denominator = (squares + C1) * (square_x + square_y - squares + C2)
    return (numerator / denominator).mean((1, 2, 3))


def _window_means(x: Frames) -> Float[Tensor, "n 1 hv wv"]:
    """Return the weighted means over the windows inside the frame: products of matrices, faster."""
    rows, columns = (_window_matrix(size, x.device) for size in x.shape[-2:])
    return rows @ x @ columns.T


@functools.lru_cache(maxsize=32)
@torch.inference_mode(False)
def _window_matrix(size: int, device: torch.device) -> Float[Tensor, "windows size"]:
    """Return the weights of every window that lies inside `size` pixels, a row each."""
    if size < WINDOW:
        raise ValueError(f"SSIM needs frames of at least {WINDOW} pixels a side, got {size}")
    weight = torch.exp(-((torch.arange(WINDOW) - WINDOW // 2) ** 2) / (2 * SIGMA**2))
    places = torch.arange(size - WINDOW + 1)[:, None] + torch.arange(WINDOW)
    bands = torch.zeros(len(places), size)
    return bands.scatter_(1, places, (weight / weight.sum()).expand_as(places).clone()).to(device)
