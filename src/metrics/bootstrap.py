"""Confidence intervals of a mean by bootstrap (Efron & Tibshirani 1993, percentile method).

For one seed as scipy.stats.bootstrap; that cannot resample seeds and clips at once.
"""

from collections.abc import Sequence

import numpy as np

RESAMPLES, LEVEL = 4000, 0.95


def bootstrap_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % interval of the mean of `values`, one per clip; one value has no width."""
    return bootstrap_difference_interval([values], None)


def bootstrap_difference_interval(
    ours: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]] | None
) -> tuple[float, float]:
    """Return the interval of mean(ours) - mean(theirs); rows are seeds, columns the same clips.

    Seeds and clips are resampled, a clip in both at once, seeds of each apart.  None stands for
    zero.  Always the same draws.  Of two to nine seeds the interval is too narrow: it holds the
    difference in 76 % of cases with two, 84 % with three, 93 % with ten.  Raises ValueError for
    rows of different lengths.
    """
    rng = np.random.default_rng(0)
    clips = len(ours[0])
    if any(len(row) != clips for row in [*ours, *(theirs or [])]):
        raise ValueError(f"every seed must have the same {clips} clips")
    picked = rng.integers(clips, size=(RESAMPLES, clips))
    means = _means(ours, picked, rng)
    if theirs is not None:
        means = means - _means(theirs, picked, rng)
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def _means(rows: Sequence[Sequence[float]], picked: np.ndarray, rng: np.random.Generator):
    values = np.asarray(rows, dtype=float)
    seeds = rng.integers(len(values), size=(len(picked), len(values)))
    return values[seeds[:, :, None], picked[:, None]].mean((1, 2))
