"""No learning: the exponential high-pass of the events, the least that a method must beat.

Log intensity is the sum of polarity times threshold; without the first frame only its changes are
known, and errors pile up, so old events are forgotten exponentially (Scheerlinck et al. 2018).
"""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn

from src.sim.optics import Position, centre, layout


class HighPass(nn.Module):
    """Leaky sum of a view's events, drawn as grey 0.5 plus `gain` times the sum.

    `keep`: what is left of a sum after one window (0.9: ten windows of memory).  `source`:
    `centre`, the centre view, or `median`, the median over all views, pixel by pixel.
    """

    views = None

    def __init__(self, keep: float = 0.9, gain: float = 0.08, source: str = "centre"):
        super().__init__()
        if not 0 <= keep <= 1:
            raise ValueError(f"baseline.keep must be in [0, 1], got {keep}")
        if source not in ("centre", "median"):
            raise ValueError(f"baseline.source must be centre or median, got {source}")
        self.keep, self.gain, self.source = keep, gain, source

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Tensor | None = None,
        *,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Tensor]:
        """Return the frame in [0, 1] and the leaky sum (n, 1, h, w)."""
        events = voxels.sum(2)
        if self.source == "centre":
            change = events[:, centre(positions or layout(events.shape[1])), None]
        else:
            change = events.median(dim=1, keepdim=True).values
        state = change if state is None else self.keep * state + change
        return (0.5 + self.gain * state).clamp(0, 1), state
