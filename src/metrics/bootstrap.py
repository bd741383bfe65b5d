"""Confidence intervals of a mean by bootstrap (Efron & Tibshirani 1993, percentile method).

For one seed as scipy.stats.bootstrap.  A mean over several seeds also varies with the seeds, of
which there are too few to resample: each resample of the clips is moved by Student's t times the
standard error over seeds.
"""

import math
from collections.abc import Sequence

import numpy as np

RESAMPLES, LEVEL = 4000, 0.95


def bootstrap_interval(
    values: Sequence[float], weights: Sequence[float] | None = None
) -> tuple[float, float]:
    """Return the 95 % interval of the mean of `values`, one per clip; one value has no width."""
    return bootstrap_difference_interval([values], None, weights)


def bootstrap_difference_interval(
    ours: Sequence[Sequence[float]], theirs: Sequence[Sequence[float]] | None,
    weights: Sequence[float] | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Return the interval of mean(ours) - mean(theirs); rows are seeds, columns the same clips.

    `weights`: of the clips in a mean, such as their numbers of frames; None: all alike.

    Clips are resampled, in both at once; what the seeds add is independent in the two, Student's t
    of seeds - 1 degrees of freedom (0 for one seed).  None stands for zero.  Always the same draws.
    Of few clips it is narrow: it holds the mean of one seed in 89 % of cases with 9 clips, in 94 %
    with 27.  Raises ValueError for rows of different lengths.
    """
    rng = np.random.default_rng(0)
    clips = len(ours[0])
    if any(len(row) != clips for row in [*ours, *(theirs or [])]):
        raise ValueError(f"every seed must have the same {clips} clips")
    picked = rng.integers(clips, size=(RESAMPLES, clips))
    shares = np.ones(clips) if weights is None else np.asarray(weights, dtype=float)
    means = _means(ours, shares, picked, rng)
    if theirs is not None:
        means = means - _means(theirs, shares, picked, rng)
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def _means(
    rows: Sequence[Sequence[float]], shares: np.ndarray, picked: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    values = np.asarray(rows, dtype=float)
    means, seeds = np.average(values.mean(0)[picked], axis=1, weights=shares[picked]), len(values)
    if seeds > 1:
        standard_error = np.average(values, axis=1, weights=shares).std(ddof=1) / math.sqrt(seeds)
        means = means + standard_error * rng.standard_t(seeds - 1, len(means))
    return means
