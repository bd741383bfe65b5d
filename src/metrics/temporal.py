"""What turbulence does to a video and PSNR hardly sees: it moves things that should not move.

The residual displacement of a reconstruction against the truth is measured block by block with
gradient least squares (Lucas & Kanade 1981), iterated; its change from frame to frame is wobble.
Gain and offset of each block are fitted away first, so brightness does not matter.  On a photograph
warped smoothly by 0.5 to 3 px rms, wobble and residual read 7 to 16 % high; blur that the truth
has not shows in residual (0.2 px at a blur of 1 px) and not in wobble.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

BLOCK = 16  # side of a block in pixels
REACH = 8.0  # largest displacement that is believed, in pixels: over 2.5 sigma of strong tilt
SMOOTHING = (15, 15, 7, 1, 1)  # side of the box blur of each iteration: coarse to fine
TEXTURE = 1e-4  # least mean square gradient, in (grey levels / pixel)^2, of a block that is used


def displacement(
    frames: Float[Tensor, "frames 1 h w"], target: Float[Tensor, "frames 1 h w"]
) -> tuple[Float[Tensor, "frames 2 rows columns"], Float[Tensor, "frames rows columns"]]:
    """Return by how much each block of `frames` is shifted against `target`, (x, y) in pixels, and
    its weight: the target's mean square gradient along its weaker direction, 0 without texture.

    Blocks are 16 pixels wide; shifts are cut at 8 pixels.
    """
    a, b, c = _structure(*gradients(target))
    weaker = (a + c) / 2 - ((a - c) ** 2 / 4 + b * b).sqrt()  # eigenvalue of each block's tensor
    weight = torch.where(weaker > TEXTURE, weaker, torch.zeros_like(weaker))
    shift = torch.zeros(len(target), 2, *weight.shape[1:], dtype=target.dtype, device=target.device)
    for side in SMOOTHING:
        step = _step(_smooth(frames, side), _smooth(target, side), shift)
        longest = max(1.0, side / 5)  # beyond, the picture is no plane to a blur of this side
        shift = (shift + step.clamp(-longest, longest)).clamp(-REACH, REACH)
    return shift * (weight > 0)[:, None], weight


def pull(
    frames: Float[Tensor, "n c h w"], shift: Float[Tensor, "n 2 h w"], mode: str = "bilinear"
) -> Float[Tensor, "n c h w"]:
    """Return the frames with what lies `shift` (x, y), in pixels, from each pixel brought there."""
    height, width = frames.shape[-2:]
    rows, columns = torch.arange(height).to(frames), torch.arange(width).to(frames)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    place = [(2 * (x + shift[:, 0]) + 1) / width - 1, (2 * (y + shift[:, 1]) + 1) / height - 1]
    grid = torch.stack(place, -1)
    return functional.grid_sample(frames, grid, mode, padding_mode="border", align_corners=False)


def residual(
    frames: Float[Tensor, "frames 1 h w"], target: Float[Tensor, "frames 1 h w"]
) -> Float[Tensor, " frames"]:
    """Return the rms displacement of each frame against the truth, in pixels per axis."""
    return _rms(*displacement(frames, target))


def wobble(
    frames: Float[Tensor, "frames 1 h w"], target: Float[Tensor, "frames 1 h w"]
) -> Float[Tensor, " frames-1"]:
    """Return the rms change of the displacement from each frame to the next, in pixels per axis.

    A block counts as much as its weaker weight in the two frames.
    """
    shift, weight = displacement(frames, target)
    return _rms(shift[1:] - shift[:-1], torch.minimum(weight[1:], weight[:-1]))


def straightness(path: Float[Tensor, "frames axes"], truth: Float[Tensor, "frames axes"]) -> float:
    """Return the rms distance in pixels of a path, (x, y) or along one axis, from the known one,
    after removing the constant offset between them.
    """
    error = path - truth
    return float((error - error.mean(0)).square().sum(1).mean().sqrt())


def _structure(x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    return _blocks(torch.cat([x * x, x * y, y * y], dim=1)).unbind(1)


def _step(frames: Tensor, target: Tensor, shift: Tensor) -> Tensor:
    """Return the least-squares correction of `shift`."""
    x, y = gradients(target)
    a, b, c = _structure(x, y)
    smooth = functional.interpolate(shift, frames.shape[-2:], mode="bilinear")
    difference = _matched(pull(frames, smooth), target) - target
    u, v = _blocks(torch.cat([x * difference, y * difference], dim=1)).unbind(1)
    determinant = (a * c - b * b).clamp(min=1e-12)
    return torch.stack([b * v - c * u, b * u - a * v], dim=1) / determinant[:, None]


def _smooth(pictures: Tensor, side: int) -> Tensor:
    half = side // 2
    rows = functional.avg_pool2d(pictures, (side, 1), 1, (half, 0), count_include_pad=False)
    return functional.avg_pool2d(rows, (1, side), 1, (0, half), count_include_pad=False)


def gradients(
    pictures: Float[Tensor, "n c h w"],
) -> tuple[Float[Tensor, "n c h w"], Float[Tensor, "n c h w"]]:
    """Return the slopes along x and y, per pixel, by central differences."""
    padded = functional.pad(pictures, (1, 1, 1, 1), mode="replicate")
    x = (padded[..., 1:-1, 2:] - padded[..., 1:-1, :-2]) / 2
    y = (padded[..., 2:, 1:-1] - padded[..., :-2, 1:-1]) / 2
    return x, y


def _blocks(maps: Tensor) -> Tensor:
    return functional.avg_pool2d(maps, min(BLOCK, *maps.shape[-2:]))


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


def _rms(shift: Tensor, weight: Tensor) -> Tensor:
    squared = shift.square().mean(1)
    total = weight.sum((1, 2))
    return ((squared * weight).sum((1, 2)) / total.clamp(min=1e-12)).sqrt()
