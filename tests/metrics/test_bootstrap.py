"""Intervals against the normal ones, and pairing."""

import numpy as np
import pytest
from scipy import stats

from src.metrics.bootstrap import (
    RESAMPLES,
    bootstrap_difference_interval,
    bootstrap_interval,
    compute_interval_coverage,
)


def test_the_interval_of_many_values_is_the_normal_one():
    values = np.random.default_rng(1).normal(3.0, 2.0, 400)
    low, high = bootstrap_interval(values.tolist())
    half = 1.96 * values.std() / 20
    assert low == pytest.approx(values.mean() - half, abs=0.12 * half)
    assert high == pytest.approx(values.mean() + half, abs=0.12 * half)


def test_clips_are_paired():
    rng = np.random.default_rng(2)
    hard = rng.normal(0, 10.0, 27)  # what the clip does to every network
    ours = [(hard + 0.5 + rng.normal(0, 0.1, 27)).tolist() for _ in range(3)]
    theirs = [(hard + rng.normal(0, 0.1, 27)).tolist() for _ in range(3)]
    low, high = bootstrap_difference_interval(ours, theirs)
    assert 0.4 < low < 0.5 < high < 0.6
    assert np.diff(bootstrap_interval(hard.tolist()))[0] > 5


def test_of_few_seeds_it_is_student_s_interval():
    apart = [[0.0] * 9, [1.0] * 9, [2.0] * 9]
    half = stats.t.ppf(0.975, 2) / np.sqrt(3)
    low, high = bootstrap_difference_interval(apart, None)
    assert low == pytest.approx(1 - half, rel=0.1) and high == pytest.approx(1 + half, rel=0.1)


@pytest.mark.parametrize("clips", [2, 4, 9, 27])
def test_how_often_it_holds_the_mean_is_what_is_computed(clips):
    rng, held = np.random.default_rng(1), 0
    for _ in range(1000):
        low, high = bootstrap_interval((0.5 + rng.normal(size=clips)).tolist())
        held += low <= 0.5 <= high
    assert compute_interval_coverage(clips) == pytest.approx(held / 1000, abs=0.03)


@pytest.mark.parametrize(
    ("clips", "stated"), [(2, 0.5), (3, 0.75), (9, 0.90), (12, 0.91), (27, 0.93)]
)
def test_how_often_it_holds_the_mean_is_what_is_stated(clips, stated):
    assert compute_interval_coverage(clips) == pytest.approx(stated, abs=0.005)


def test_of_many_clips_it_holds_the_mean_in_95_of_100_cases_and_one_has_none():
    assert compute_interval_coverage(10_000) == pytest.approx(0.95, abs=0.001)
    with pytest.raises(ValueError, match="groups must be >= 2, got 1"):
        compute_interval_coverage(1)


def test_of_three_seeds_it_holds_the_difference_as_often_as_it_says():
    rng, held = np.random.default_rng(4), 0
    for _ in range(200):
        ours, theirs = (rng.normal(0, 0.2, (3, 1)) + rng.normal(0, 0.1, (3, 27)) for _ in "ab")
        low, high = bootstrap_difference_interval((ours + 0.5).tolist(), theirs.tolist())
        held += low <= 0.5 <= high
    assert held >= 186


def test_it_is_scipy_s_where_there_is_one_seed():
    values = np.random.default_rng(3).normal(0.5, 0.1, 12)
    theirs = stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    assert bootstrap_interval(values.tolist()) == pytest.approx(
        (theirs.low, theirs.high), abs=1e-12
    )


def test_clips_of_one_photograph_are_drawn_together():
    rng, held, apart = np.random.default_rng(6), 0, 0
    groups = np.repeat(np.arange(20), 5).tolist()
    for _ in range(200):
        values = (np.repeat(rng.normal(size=20), 5) + 0.5 * rng.normal(size=100)).tolist()
        (low, high), (least, most) = (
            bootstrap_interval(values, None, groups),
            bootstrap_interval(values),
        )
        held, apart = held + (low <= 0 <= high), apart + (least <= 0 <= most)
    assert held / 200 == pytest.approx(0.93, abs=0.04) and apart / 200 < 0.7


def test_weights_count_within_a_photograph():
    groups = ["a", "a", "b", "c"]
    merged = bootstrap_interval([2.0, 7.0, 1.0], [4.0, 1.0, 2.0])
    assert bootstrap_interval([1.0, 3.0, 7.0, 1.0], [2.0, 2.0, 1.0, 2.0], groups) == merged


def test_a_photograph_for_each_clip_changes_nothing():
    values = np.random.default_rng(7).normal(size=9).tolist()
    assert bootstrap_interval(values, None, list("ihgfedcba")) == bootstrap_interval(values)


@pytest.mark.parametrize(("values", "groups"), [([0.25], None), ([0.25, 0.5], ["a", "a"])])
def test_of_one_clip_or_photograph_there_is_no_interval(values, groups):
    assert np.isnan(bootstrap_interval(values, None, groups)).all()


def test_rows_must_be_of_the_same_clips():
    with pytest.raises(ValueError, match="same 2 clips"):
        bootstrap_difference_interval([[1.0, 2.0]], [[1.0]])


def test_arrays_are_what_lists_are():
    values, others = np.random.default_rng(0).random((2, 2, 6))
    groups = np.array([0, 0, 1, 1, 2, 2])
    assert bootstrap_interval(values[0], groups=groups) == bootstrap_interval(
        list(values[0]), groups=list(groups)
    )
    assert bootstrap_difference_interval(values, others) == bootstrap_difference_interval(
        values.tolist(), others.tolist()
    )
