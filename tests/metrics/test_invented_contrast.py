"""Invented contrast of frames whose value is known."""

import math

import numpy as np
import pytest

from src.metrics.invented_contrast import find_unseen_pixels, invented_contrast


def scene() -> tuple[np.ndarray, np.ndarray]:
    """A frame whose left half has contrast 1 and where its events are."""
    frame = np.full((40, 80), 0.5)
    frame[:, :20], frame[:, 20:40] = 0, 1
    has_events = np.zeros(frame.shape, bool)
    has_events[:, 20:40] = True
    return frame, has_events


def test_unseen_begins_beyond_12_px_of_events():
    _, has_events = scene()
    unseen = find_unseen_pixels(has_events)
    assert unseen[:, 52:].all() and not unseen[:, 8:52].any() and unseen[:, :8].all()


def test_one_value_is_nothing_invented():
    frame, has_events = scene()
    frame[:, :8] = 0.5
    assert invented_contrast(frame, find_unseen_pixels(has_events)) == 0


@pytest.mark.parametrize("amplitude", [0.01, 0.2])
def test_clouds_count_with_their_standard_deviation(amplitude):
    frame, has_events = scene()
    unseen = find_unseen_pixels(has_events)
    clouds = np.where(np.arange(unseen.sum()) % 2, amplitude, -amplitude)
    frame[unseen] = 0.5 + clouds
    assert invented_contrast(frame, unseen) == pytest.approx(amplitude)


def test_all_seen_and_nothing_seen_have_none():
    frame, has_events = scene()
    for mask in (np.zeros_like(has_events), find_unseen_pixels(np.zeros_like(has_events))):
        assert math.isnan(invented_contrast(frame, mask))


@pytest.mark.parametrize("kind", [np.uint8, float])
def test_masks_of_numbers_are_those_of_truth_values(kind):
    has_events = np.zeros((64, 64), bool)
    has_events[20, 30] = True
    unseen = find_unseen_pixels(has_events)
    assert np.array_equal(find_unseen_pixels(has_events.astype(kind)), unseen)
    frame = np.random.default_rng(0).random((64, 64))
    assert invented_contrast(frame, unseen.astype(kind)) == invented_contrast(frame, unseen)
