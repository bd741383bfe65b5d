"""Tone of pictures to look at."""

import numpy as np
import pytest

from src.recordings.tone import ToneCurve, build_output_curve

RAMP = np.linspace(0.4, 0.8, 101, dtype=np.float32).reshape(1, 101)


def test_static_pictures_stay_and_fill_the_range():
    curve = ToneCurve("auto")
    shown = [curve.apply(RAMP, k / 100) for k in range(5)]
    assert all(np.array_equal(shown[0], one) for one in shown)
    assert shown[0].min() == 0 and shown[0].max() == 1
    assert shown[0][0, 50] == pytest.approx(0.5, abs=1e-5)


def test_a_step_is_followed_without_a_jump_or_overshoot():
    curve, rng = ToneCurve("auto", 0.5), np.random.default_rng(0)
    curve.apply(RAMP, 0.0)
    ends = []
    for k in range(1, 301):
        curve.apply(RAMP - 0.3 + 1e-4 * rng.random(RAMP.shape), k / 100)
        ends.append(curve.ends[0])
    assert (np.diff(ends) < 2e-4).all() and np.abs(np.diff(ends)).max() < 0.3 * 0.021
    assert ends[49] == pytest.approx(0.404 - 0.3 * (1 - np.exp(-1)), abs=2e-3)
    assert ends[-1] == pytest.approx(0.104, abs=2e-3)


def test_none_is_the_picture_itself():
    assert ToneCurve("none").apply(RAMP, 0.0) is RAMP


def test_the_gain_is_limited_and_empty_pictures_teach_nothing():
    curve = ToneCurve("auto")
    flat = np.full((4, 4), 0.5, np.float32)
    assert np.array_equal(curve.apply(flat, 0.0), flat) and curve.ends is None
    assert np.ptp(curve.apply(0.5 + (RAMP - 0.4) / 4, 0.1)) == pytest.approx(0.4, abs=1e-5)


@pytest.mark.parametrize("tone, seconds", [("on", 1), ("auto", 0), ("auto", float("inf"))])
def test_wrong_values_are_refused(tone, seconds):
    with pytest.raises(ValueError, match="tone"):
        ToneCurve(tone, seconds)


def test_data_is_not_toned():
    with pytest.raises(ValueError, match="tone must be none for output_format=hdf5, got auto"):
        build_output_curve("auto", 0.5, "hdf5")
