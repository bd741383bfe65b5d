"""Temporal jitter: what turbulence moves from frame to frame, which PSNR hardly sees.

The displacement of a reconstruction against the truth is measured block by block with gradient
least squares (Lucas & Kanade 1981), iterated; its change from frame to frame is temporal jitter.
Gain and offset of each block are fitted first, so brightness does not matter.  On a photograph
warped smoothly by 0.5 to 3 px rms, jitter reads 7 to 16 % high.  A part without the scene reads as
if it moved with the truth: of a blank picture jitter says nothing.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

BLOCK_SIZE = 16  # pixels, side of a block
MAX_SHIFT_PX = 8.0  # largest displacement in pixels: over 2.5 sigma of strong tilt
SMOOTHING = (15, 15, 7, 1, 1)  # side of the box blur of each iteration: coarse to fine
MIN_TEXTURE = 1e-4  # least mean square gradient of a block that counts, (grey levels / pixel)^2

Video = Float[Tensor, "frames 1 h w"]


def estimate_block_displacement(
    frames: Video, target: Video
) -> tuple[Float[Tensor, "frames 2 rows columns"], Float[Tensor, "frames rows columns"]]:
    """Return by how much each block of `frames` is shifted against `target`, (x, y) in pixels, and
    its weight: the target's mean square gradient along its weaker direction, 0 without texture.

    Blocks are 16 pixels wide; shifts are cut at 8 pixels.
    """
    weight = _texture(target)
    shift = torch.zeros(len(target), 2, *weight.shape[1:], dtype=target.dtype, device=target.device)
    for side in SMOOTHING:
        step = _step(_smooth(frames, side), _smooth(target, side), shift)
        longest = max(1.0, side / 5)  # beyond, the picture is no plane to a blur of this side
        shift = (shift + step.clamp(-longest, longest)).clamp(-MAX_SHIFT_PX, MAX_SHIFT_PX)
    return shift * (weight > 0)[:, None], weight


def backward_warp(
    frames: Float[Tensor, "n c h w"], shift: Float[Tensor, "n 2 h w"], mode: str = "bilinear"
) -> Float[Tensor, "n c h w"]:
    """Return the frames with what lies `shift` (x, y), in pixels, from each pixel brought there."""
    height, width = frames.shape[-2:]
    rows, columns = torch.arange(height).to(frames), torch.arange(width).to(frames)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    place = [(2 * (x + shift[:, 0]) + 1) / width - 1, (2 * (y + shift[:, 1]) + 1) / height - 1]
    grid = torch.stack(place, -1)
    return functional.grid_sample(frames, grid, mode, padding_mode="border", align_corners=False)


def find_textured_pairs(target: Video) -> Bool[Tensor, " frames-1"]:
    """Return which pairs of successive frames have a block with texture in both: those of which
    there is a jitter."""
    weights = _texture(target)
    return (torch.minimum(weights[1:], weights[:-1]) > 0).any(-1).any(-1)


def temporal_jitter_px(frames: Video, target: Video) -> Float[Tensor, " frames-1"]:
    """Return the rms change of the displacement from each frame to the next, in pixels per axis.

    Blur of what moves reads as jitter, too: Gaussian blur of sigma 2 and 4 px alone as 0.1 and
    0.3 px on a photograph that moves 0.8 px a frame, as 0.3 and 0.7 px on one that moves 2.3; of
    what rests as 0 (tests/metrics/test_temporal.py).
    A block counts as much as its weaker weight in the two frames; 0 where `find_textured_pairs`
    has none.
    """
    shift, weights = estimate_block_displacement(frames, target)
    squared = (shift[1:] - shift[:-1]).square().mean(1)
    weight = torch.minimum(weights[1:], weights[:-1])
    total = weight.sum((1, 2)).clamp(min=1e-12)
    return ((squared * weight).sum((1, 2)) / total).sqrt()


def _texture(target: Video) -> Float[Tensor, "frames rows columns"]:
    """Return each block's mean square gradient along its weaker direction, 0 below MIN_TEXTURE."""
    a, b, c = _structure(*_gradients(target))
    weaker = (a + c) / 2 - ((a - c) ** 2 / 4 + b * b).sqrt()  # eigenvalue of each block's tensor
    return torch.where(weaker > MIN_TEXTURE, weaker, torch.zeros_like(weaker))


def _structure(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    return _blocks(torch.cat([x * x, x * y, y * y], dim=1)).unbind(1)


def _step(frames: Tensor, target: Tensor, shift: Tensor) -> Tensor:
    """Return the least-squares correction of `shift`."""
    x, y = _gradients(target)
    a, b, c = _structure(x, y)
    smooth = functional.interpolate(shift, frames.shape[-2:], mode="bilinear")
    difference = _matched(backward_warp(frames, smooth), target) - target
    u, v = _blocks(torch.cat([x * difference, y * difference], dim=1)).unbind(1)
    determinant = (a * c - b * b).clamp(min=1e-12)
    return torch.stack([b * v - c * u, b * u - a * v], dim=1) / determinant[:, None]


def _smooth(pictures: Tensor, side: int) -> Tensor:
    half = side // 2
    rows = functional.avg_pool2d(pictures, (side, 1), 1, (half, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), 1, (0, half), count_include_pad=False)


def _gradients(pictures: Tensor) -> tuple[Tensor, Tensor]:
    """Return the slopes along x and y, per pixel, by central differences."""
    padded = functional.pad(pictures, (1, 1, 1, 1), mode="replicate")
    x = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    y = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    return x, y


def _blocks(maps: Tensor) -> Tensor:
    return functional.avg_pool2d(maps, min(BLOCK_SIZE, *maps.shape[-2:]))


def _matched(frames: Tensor, target: Tensor) -> Tensor:
    """Fit the gain and offset of `frames` to `target` over each block and its neighbours."""

    def mean(maps: Tensor) -> Tensor:
        return functional.avg_pool2d(_blocks(maps), 3, 1, 1, count_include_pad=False)

    m, n = mean(frames), mean(target)
    covariance = mean(frames * target) - m * n
    gain = (covariance / (mean(frames * frames) - m * m).clamp(min=1e-6)).clamp(min=0)
    fit = torch.cat([gain, n - gain * m], dim=1)
    gain, offset = functional.interpolate(fit, frames.shape[-2:], mode="bilinear").split(1, dim=1)
    return gain * frames + offset
