"""Confidence intervals of a mean by bootstrap (Efron & Tibshirani 1993, percentile method).

For one seed as scipy.stats.bootstrap.  A mean over several seeds also varies with the seeds, of
which there are too few to resample: each resample of the clips is moved by Student's t times the
standard error over seeds.
"""

import math
from collections.abc import Hashable, Sequence
from statistics import NormalDist

import numpy as np
from scipy.special import stdtr

RESAMPLES, LEVEL = 4000, 0.95
Rows = Sequence[Sequence[float] | np.ndarray] | np.ndarray


def bootstrap_interval(
    values: Sequence[float] | np.ndarray, weights: Sequence[float] | np.ndarray | None = None,
    groups: Sequence[Hashable] | np.ndarray | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Return the 95 % interval of the mean of `values`, one per clip; see
    `bootstrap_difference_interval`."""
    return bootstrap_difference_interval([values], None, weights, groups)


def bootstrap_difference_interval(
    ours: Rows, theirs: Rows | None,
    weights: Sequence[float] | np.ndarray | None = None,
    groups: Sequence[Hashable] | np.ndarray | None = None,
) -> tuple[float, float]:  # fmt: skip
    """Return the interval of mean(ours) - mean(theirs); rows are seeds, columns the same clips.

    `weights`: of the clips in a mean, such as their numbers of frames; None: all alike.  `groups`:
    what each clip shows, such as its photograph, None: each something else; of one group there is
    no interval, (NaN, NaN).

    Groups of clips are resampled, in both at once; what the seeds add is independent in the two,
    Student's t of seeds - 1 degrees of freedom (0 for one seed).  None stands for zero.  Always the
    same draws.  Of few groups it is narrow: `compute_interval_coverage` says how often it holds the
    mean.  Raises ValueError for rows of different lengths.
    """
    rng = np.random.default_rng(0)
    clips = len(ours[0])
    if any(len(row) != clips for row in [*ours, *([] if theirs is None else theirs)]):
        raise ValueError(f"every seed must have the same {clips} clips")
    groups = range(clips) if groups is None else groups
    places = {group: n for n, group in enumerate(dict.fromkeys(groups))}
    if len(places) < 2:
        return math.nan, math.nan
    members = np.array([places[group] for group in groups])
    picked = rng.integers(len(places), size=(RESAMPLES, len(places)))
    shares = np.ones(clips) if weights is None else np.asarray(weights, dtype=float)
    means = _means(ours, shares, members, picked, rng)
    if theirs is not None:
        means = means - _means(theirs, shares, members, picked, rng)
    tail = 50 * (1 - LEVEL)
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)


def compute_interval_coverage(groups: int) -> float:
    """Return the share of cases, about, in which the interval of one seed over so many `groups`
    (2 or more) holds the mean: 0.5 of two, 0.75 of three, 0.90 of nine, 0.91 of twelve, 0.93 of 27.

    Of normal values, whose resampled means spread by sqrt((G - 1) / G) of the standard error of G:
    P(|t| < 1.96 sqrt((G - 1) / G)) with Student's t of G - 1 degrees of freedom.  Of two groups the
    ends are the two values.  tests/metrics/test_bootstrap.py compares it with draws.  Raises
    ValueError for fewer.
    """
    if groups < 2:
        raise ValueError(f"groups must be >= 2, got {groups}")
    if groups == 2:
        return 0.5
    quantile = NormalDist().inv_cdf((1 + LEVEL) / 2) * math.sqrt((groups - 1) / groups)
    return 2 * float(stdtr(groups - 1, quantile)) - 1


def _means(
    rows: Rows, shares: np.ndarray, members: np.ndarray, picked: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray:  # fmt: skip
    values, seeds = np.asarray(rows, dtype=float), len(rows)
    sums, counts = (np.bincount(members, part) for part in (values.mean(0) * shares, shares))
    means = sums[picked].sum(1) / counts[picked].sum(1)
    if seeds > 1:
        standard_error = np.average(values, axis=1, weights=shares).std(ddof=1) / math.sqrt(seeds)
        means = means + standard_error * rng.standard_t(seeds - 1, len(means))
    return means
