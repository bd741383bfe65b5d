"""No learning: the exponential high-pass of the events (Scheerlinck et al. 2018), the least that a
method must beat.
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from baselines.centre_view import find_centre_view
from src.models.network import (
    WINDOW_S,
    EventToVideoNetwork,
    check_state_sizes,
    check_voxel_shape,
)
from src.sim.optics import Position


class HighPass(EventToVideoNetwork):
    """Leaky sum of a view's events, drawn as grey 0.5 plus `gain` times the sum.

    `decay`: what is left of a sum after one window (0.9: ten windows of memory).
    `view_reduction`: centre, the centre view, or median, over all views, pixel by pixel.
    """

    def __init__(self, decay: float = 0.9, gain: float = 0.08, view_reduction: str = "centre"):
        super().__init__()
        if not 0 <= decay <= 1:
            raise ValueError(f"baseline.decay must be in [0, 1], got {decay}")
        if (got := view_reduction) not in ("centre", "median"):
            raise ValueError(f"baseline.view_reduction must be centre or median, got {got}")
        self.decay, self.gain, self.view_reduction = decay, gain, view_reduction
        self.uses_centre_view_only = view_reduction == "centre"

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Tensor | None = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Tensor]:
        """Return the frame in [0, 1] and the leaky sum (n, 1, h, w).

        Raises ValueError for another shape or number of positions, and for a state of other sizes.
        """
        check_voxel_shape(voxels)
        events = voxels.sum(2)
        if self.view_reduction == "centre":
            change = events[:, find_centre_view(events.shape[1], positions), None]
        else:
            change = events.median(dim=1, keepdim=True).values
        if state is not None:
            check_state_sizes(state, [tuple(change.shape)])
        state = change if state is None else self.decay * state + change
        return (0.5 + self.gain * state).clamp(0, 1), state
