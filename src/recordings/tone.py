"""Tone of pictures to look at: dark and light ends stretched to black and white, slowly."""

import math

import numpy as np
from jaxtyping import Float

PERCENTILES = (1.0, 99.0)
LARGEST_GAIN = 4.0
LEAST_SPREAD = 1 / 255  # between the percentiles; a flatter picture is empty


class ToneCurve:
    """Stretches PERCENTILES of pictures to black and white, by LARGEST_GAIN at most.

    The percentiles follow the pictures as a first-order filter in recorded time; the first picture
    sets them, one that is empty or equal to the last leaves them.  For display, never for scores.
    Raises ValueError for values that `tone` and `tone_time_constant_s` cannot have.
    """

    def __init__(self, tone: str = "none", tone_time_constant_s: float = 0.5):
        if tone not in ("auto", "none"):
            raise ValueError(f"tone must be auto or none, got {tone}")
        if not 0 < tone_time_constant_s < math.inf:
            raise ValueError(f"tone_time_constant_s must be > 0, got {tone_time_constant_s}")
        self.tone, self.time_constant_s = tone, tone_time_constant_s
        self.ends: np.ndarray | None = None  # the two percentiles, filtered
        self.last: tuple[float, np.ndarray] | None = None  # time in s and picture

    def apply(
        self, picture: Float[np.ndarray, "h w *rgb"], time_s: float
    ) -> Float[np.ndarray, "h w *rgb"]:
        """Return `picture` in [0, 1], of the recorded `time_s`, as it is shown."""
        if self.tone == "none":
            return picture
        self._follow(picture, time_s)
        if self.ends is None:
            return picture
        low, high = self.ends
        gain = min(1 / (high - low), LARGEST_GAIN)
        return ((picture - (low + high) / 2) * gain + 0.5).clip(0, 1).astype(np.float32)

    def _follow(self, picture: np.ndarray, time_s: float) -> None:
        before_s, before = self.last or (time_s, None)
        self.last = (time_s, picture)
        if before is picture or (before is not None and np.array_equal(before, picture)):
            return
        ends = np.percentile(picture, PERCENTILES)
        if not ends[1] - ends[0] >= LEAST_SPREAD:
            return
        if self.ends is None:
            self.ends = ends
        share = -math.expm1(-max(time_s - before_s, 0.0) / self.time_constant_s)
        self.ends = self.ends + share * (ends - self.ends)


def build_output_curve(tone: str, tone_time_constant_s: float, output_format: str) -> ToneCurve:
    """Return the curve of a video; raises ValueError for tone=auto where frames are data."""
    if tone == "auto" and output_format not in ("mp4", "gif", "film"):
        raise ValueError(f"tone must be none for output_format={output_format}, got {tone}")
    return ToneCurve(tone, tone_time_constant_s)
