"""A clip read backwards first, so that its first frame already shows the scene; not for live use.

Events in the opposite order with the opposite polarity are those of the scene played backwards.
"""

import math
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor

from src.models.network import EventToVideoNetwork, VideoMethod, unroll

if TYPE_CHECKING:
    from src.sim.pipeline import Sample


def check_backward_warmup_s(seconds: float) -> float:
    """Return `seconds`; raises ValueError for what is no length of time."""
    if not 0 <= seconds < math.inf:
        raise ValueError(f"backward_warmup_s must be >= 0 seconds and finite, got {seconds}")
    return seconds


def reverse_voxels(voxels: Float[Tensor, "*any bins h w"]) -> Float[Tensor, "*any bins h w"]:
    """Return the grid of a window's events backwards in time."""
    return -voxels.flip(-3)


class BackwardWarmup(VideoMethod):
    """`network` after it has read the first `seconds` of a clip backwards."""

    def __init__(self, network: VideoMethod, seconds: float):
        super().__init__()
        if not isinstance(network, EventToVideoNetwork):
            kind = type(network).__name__
            raise ValueError(f"backward_warmup_s must be 0 for {kind}, no recurrent network")
        self.network, self.views = network, network.views
        self.seconds = check_backward_warmup_s(seconds)

    def reconstruct_clip(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        voxels, window_s, positions = sample.voxels, sample.window_s, sample.positions
        windows = max(round(self.seconds / float(window_s[0])), 1)
        backwards = reverse_voxels(voxels[:, :windows].flip(1))
        _, state = unroll(self.network, backwards, window_s=window_s, positions=positions)
        return unroll(self.network, voxels, state, window_s=window_s, positions=positions)[0]
