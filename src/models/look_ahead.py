"""A clip read backwards first, so that its first picture already knows what comes.

Events in the opposite order with the opposite polarity are those of the same scene played
backwards.  A recurrent network that reads the beginning of a clip so starts with the scene in its
state instead of with grey.  For clips and recordings, not for what is live: the first pictures
depend on later events.
"""

import math
from typing import TYPE_CHECKING

from jaxtyping import Float
from torch import Tensor, nn

from src.models.unroll import unroll

if TYPE_CHECKING:
    from src.sim.pipeline import Sample


def checked(seconds: float) -> float:
    """Return `seconds`; raises ValueError for what is no length of time."""
    if not 0 <= seconds < math.inf:
        raise ValueError(f"look_ahead_s must be >= 0 seconds and finite, got {seconds}")
    return seconds


def reversed_grid(voxels: Float[Tensor, "*any bins h w"]) -> Float[Tensor, "*any bins h w"]:
    """Return the grid of a window's events backwards in time."""
    return -voxels.flip(-3)


class LookAhead(nn.Module):
    """`source`, a network that goes window by window, after it has read the first `seconds` of a
    clip backwards.
    """

    def __init__(self, source: nn.Module, seconds: float):
        super().__init__()
        self.source, self.views, self.seconds = source, source.views, checked(seconds)
        if hasattr(source, "video"):
            kind = type(source).__name__
            raise ValueError(f"look_ahead_s must be 0 for {kind}, which is no recurrent network")

    def video(self, sample: "Sample") -> Float[Tensor, "n windows 1 h w"]:
        """Return the frame of every window."""
        options = {"window_s": sample.window_s, "positions": sample.positions}
        ahead = max(round(self.seconds / float(sample.window_s[0])), 1)
        backwards = reversed_grid(sample.voxels[:, :ahead].flip(1))
        _, state = unroll(self.source, backwards, **options)
        return unroll(self.source, sample.voxels, state, **options)[0]
