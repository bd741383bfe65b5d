"""Which brightness events have revealed so far, and a loss where they have not."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from src.losses.terms import FlatnessTerm
from src.metrics.image import Frames, FrameValues

REVEALING_CHANGE = 0.12  # least range of log(intensity) of the ground truth that events show
DARK = 0.02  # added to intensity in [0, 1] before its logarithm
REVEALING_DENSITY = 0.3  # events per pixel and view so far, in a square of DENSITY_SIDE_PX
NOISE_FACTOR = 2.0  # and above so many times the noise expected
DENSITY_SIDE_PX = 9
REACH_PX = 8  # from a revealed pixel: brightness on both sides of an edge is known


def find_revealed(
    target: Float[Tensor, "n windows 1 h w"],
    voxels: Float[Tensor, "n windows views bins h w"],
    threshold: Float[Tensor, " n"],
    noise_per_window: Float[Tensor, " n"],
) -> Bool[Tensor, "n windows 1 h w"]:
    """Return where events have revealed the brightness up to each window.

    That is within REACH_PX of where log(intensity) of the ground truth has changed by the contrast
    `threshold`, at least REVEALING_CHANGE, since the first window, or events were denser than noise
    (`noise_per_window`: expected noise events of a pixel in a window), as at a static edge through
    turbulence.
    """
    log = torch.log(target + DARK)
    change = threshold.to(log).clamp(min=REVEALING_CHANGE).view(-1, 1, 1, 1, 1)
    has_changed = log.cummax(1).values - log.cummin(1).values > change
    events = torch.linalg.vector_norm(voxels, 1, (2, 3)).cumsum(1) / voxels.shape[2]
    side = DENSITY_SIDE_PX
    density = functional.avg_pool2d(events, side, 1, side // 2, count_include_pad=False)
    windows = torch.arange(1, voxels.shape[1] + 1, device=voxels.device)
    noise = noise_per_window.to(density)[:, None] * windows
    is_dense = density > REVEALING_DENSITY + NOISE_FACTOR * noise[..., None, None]
    known = (has_changed[:, :, 0] | is_dense).float().cummax(1).values
    return functional.max_pool2d(known, 2 * REACH_PX + 1, 1, REACH_PX)[:, :, None] > 0


class UnrevealedFlatness(FlatnessTerm):
    """Asks for one value where nothing is revealed: total variation there plus `deviation_weight`
    times the mean absolute deviation from the mean there.  With this term the other terms see the
    network's own frame as the target there, so that they have no gradient.
    """

    def __init__(self, weight: float = 1.0, deviation_weight: float = 0.35):
        super().__init__(weight)
        self.deviation_weight = deviation_weight

    def forward(self, frames: Frames, is_revealed: Bool[Tensor, "n 1 h w"]) -> FrameValues:
        """Return one value per frame."""
        hidden = (~is_revealed).float()
        pixels = hidden.sum((-1, -2), keepdim=True).clamp(min=1)
        mean = (frames * hidden).sum((-1, -2), keepdim=True) / pixels
        deviation = ((frames - mean).abs() * hidden).sum((1, 2, 3)) / pixels.flatten()
        down = frames.diff(dim=-2).abs() * hidden[..., 1:, :] * hidden[..., :-1, :]
        across = frames.diff(dim=-1).abs() * hidden[..., 1:] * hidden[..., :-1]
        variation = down.mean((1, 2, 3)) + across.mean((1, 2, 3))
        return variation + self.deviation_weight * deviation
