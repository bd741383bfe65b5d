"""What keeps one bad batch from ruining a training: numbers that are none, losses that leap."""

import math
from collections import deque
from statistics import median


class NotFinite(ValueError):
    """A loss or gradient is NaN or infinite; `clips` are the numbers of the batch's clips."""

    def __init__(self, what: str, step: int, drawn: list[dict]):
        self.clips = [clip.get("clip") for clip in drawn]
        super().__init__(f"{what} at step {step}, clips {self.clips}: {drawn}")


class Guard:
    """Scales the gradients of a step whose loss leaps by `usual / loss`.

    Usual is the median of the last `last` losses, a leap more than `factor` times that.  The step
    is taken, so that counts go on, but counts no more than a usual one.  None: no leap is too far.
    The first `least` losses are only remembered.
    """

    def __init__(self, factor: float | None = None, *, last: int = 100, least: int = 20):
        if factor is not None and not factor > 1:
            raise ValueError(f"spike must be > 1 or null, got {factor}")
        self.factor, self.least = factor, least
        self.losses: deque[float] = deque(maxlen=last)

    def share(self, loss: float) -> float:
        """Return what the gradients are to be multiplied by, in (0, 1]; remember `loss`."""
        usual = median(self.losses) if len(self.losses) >= self.least else math.inf
        leaps = self.factor is not None and loss > self.factor * usual
        self.losses.append(usual if leaps else loss)
        return usual / loss if leaps else 1.0
