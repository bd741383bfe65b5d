"""What SetNet carries from window to window."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor

Context = Float[Tensor, "n c h4 w4"]


class SetNetState(NamedTuple):
    """What is carried from window to window, float32; zeros before the first."""

    view_sums: Float[Tensor, "n views taus h2 w2"]  # leaky polarity sums, per view and cell
    event_trace: Float[Tensor, "n views h2 w2"]  # events of a cell, decaying by TRACE_TAU_S
    activity: Float[Tensor, "n 1 h2 w2"]  # clock speed: 1 near supported events, decaying without
    evidence: Float[Tensor, "n 1 h2 w2"]  # supported events nearby so far, of the view with most
    is_pending: Float[Tensor, "n 1 h2 w2"]  # 1: was active since the last context update
    update_recency: Float[Tensor, "n 1 1 1"]  # exp(-age / CONTEXT_INTERVAL_S) of the last update
    context_recency: Float[Tensor, "n 1 h4 w4"]  # the same of each cell's own; 0: no context yet
    hidden: Float[Tensor, "n c h2 w2"]  # memory, in [-1, 1]
    scales: tuple[Tensor, ...]  # maps of the pyramid, those of ContextPyramid.held_map_sizes
    context_average: Context  # moving average of the pyramid's output
    context_smoothed: Context  # the same, low-pass filtered in time
