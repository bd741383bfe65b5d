"""How a video shakes, found in the video itself, and the same video held still.

Displacements between neighbouring frames, block by block, summed over time are a path; the path
less its smooth part is jitter (as video stabilisation, Liu et al., "Bundled camera paths", 2013),
scaled by Wiener's gain for what is measured wrong.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.metrics import temporal

SPAN = 2.0  # frames, standard deviation of the window over which a path is taken for straight
ERROR = 0.2  # pixels per axis, rms, to which a block's jitter is known
Video = Float[Tensor, "n frames c h w"]
NEAR = (1.0, 4.0, 1.0)  # weights of a block and its neighbours along an axis


@torch.no_grad()
def estimate_jitter(frames: Video) -> Float[Tensor, "n frames 2 h w"]:
    """Return by how much each frame is shifted, (x, y) in pixels, against where it belongs."""
    grey = frames.float().mean(2, keepdim=True)
    with torch.autocast(frames.device.type, enabled=False):
        return torch.stack([_clip_jitter(clip) for clip in grey])


def _clip_jitter(clip: Float[Tensor, "frames 1 h w"]) -> Float[Tensor, "frames 2 h w"]:
    steps = _with_neighbours(*temporal.estimate_block_displacement(clip[1:], clip[:-1]))
    path = functional.pad(steps.cumsum(0), (0, 0, 0, 0, 0, 0, 1, 0))
    shake = path - torch.einsum(
        "ts,s...->t...", local_linear_smoothing_matrix(len(path)).to(path), path
    )
    power = shake.square().mean((0, 1))
    shake = shake * power / (power + ERROR**2)
    return functional.interpolate(shake, clip.shape[-2:], mode="bilinear")


def _with_neighbours(
    steps: Float[Tensor, "steps 2 rows columns"], weight: Float[Tensor, "steps rows columns"]
) -> Float[Tensor, "steps 2 rows columns"]:
    """Return each block's mean with its neighbours', as far as they have texture; a block with none
    around moves as the picture does.
    """
    texture = weight.sqrt()[:, None]
    whole = (texture * steps).sum((2, 3), keepdim=True) / (texture.sum((2, 3), keepdim=True) + 1e-9)
    near = steps.new_tensor(NEAR)
    near = (near[:, None] * near).expand(3, 1, 3, 3)
    summed = torch.cat([texture * (steps - whole), texture], 1)
    *moved, total = functional.conv2d(summed, near, padding=1, groups=3).split(1, 1)
    return whole + torch.cat(moved, 1) / (total + 1e-9)


def local_linear_smoothing_matrix(frames: int) -> Float[Tensor, "frames frames"]:
    """Return the matrix that fits a straight line around each moment, weighed by a Gaussian, and
    takes its value there: constants and straight lines come through as they are.
    """
    t = torch.arange(float(frames))
    lag = t - t[:, None]
    weight = torch.exp(-0.5 * (lag / SPAN) ** 2)
    total, first, second = ((weight * lag**power).sum(1, keepdim=True) for power in range(3))
    spread = total * second - first**2
    return weight * (second - first * lag) / spread if frames > 1 else torch.ones(1, 1)


def backward_warp_video(frames: Video, shift: Float[Tensor, "n frames 2 h w"]) -> Video:
    """Return the frames with what lies `shift` (x, y), in pixels, from each pixel brought there."""
    every, away = (part.float().flatten(0, 1) for part in (frames, shift))
    return temporal.backward_warp(every, away, "bicubic").unflatten(0, frames.shape[:2])
