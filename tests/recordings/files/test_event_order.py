"""Order of time: sorted within the buffer, outliers dropped, clocks that restart told apart."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from src.recordings.files.event_file import EVENT
from src.recordings.files.event_order import (
    BUFFER_US,
    FEW_SHARE,
    LEAST_FEW,
    EventSorter,
    merge_in_time,
)
from src.recordings.files.survey import sort_with_smallest_buffer


def numbered(times) -> np.ndarray:
    """Return events at `times`; x and y number them in this order."""
    events = np.zeros(len(times), EVENT)
    events["t"], events["p"] = times, 1
    events["y"], events["x"] = np.divmod(np.arange(len(times)), 2**15)
    return events


def taken(order: EventSorter, events: np.ndarray, g: np.random.Generator) -> np.ndarray:
    """Return what comes out of `order`, given `events` in pieces of random length."""
    found = []
    for piece in np.split(events, np.sort(g.integers(0, len(events), int(g.integers(1, 40))))):
        found += order.add(piece)
    return np.concatenate([*found, *order.finish(), events[:0]])


def disordered(g: np.random.Generator, n: int, rate_hz: float) -> np.ndarray:
    """Return events whose order is wrong by BUFFER_US at most, over silences too; after none are
    the events so few that they could be outliers.
    """
    is_silent = (g.random(n) < 0.01) & (np.arange(n) < n - n // FEW_SHARE - LEAST_FEW)
    gaps = g.exponential(1e6 / rate_hz, n) + is_silent * g.integers(0, 10**7, n)
    times = np.sort(np.cumsum(gaps).astype(np.int64) + int(g.integers(0, 2**50)))
    late = np.argsort(times + g.integers(0, BUFFER_US + 1, n), kind="stable")
    return numbered(times[late])


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 3000), rate=st.floats(1, 1e7))
def test_any_order_within_the_buffer_comes_back_sorted_and_complete(seed, n, rate):
    g = np.random.default_rng(seed)
    events, order = disordered(g, n, rate), EventSorter()
    found = taken(order, events, g)
    assert np.array_equal(found, events[np.argsort(events["t"], kind="stable")])
    assert (order.dropped, len(order.parts)) == (0, 1)
    assert order.late == (np.maximum.accumulate(events["t"]) > events["t"]).sum()


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(300, 3000), wild=st.integers(1, 20))
def test_single_wild_times_are_dropped_and_counted(seed, n, wild):
    g = np.random.default_rng(seed)
    times = np.sort(g.integers(10**9, 10**9 + 10**6, n))
    places = np.sort(g.integers(1, n, wild))
    jumps = g.choice([-1, 1], wild) * g.integers(2 * 10**6, 10**9, wild)
    mixed = np.insert(times, places, times[places] + jumps)
    order = EventSorter()
    assert np.array_equal(taken(order, numbered(mixed), g)["t"], times)
    assert (order.dropped, order.late, len(order.parts)) == (wild, 0, 1)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31), lengths=st.lists(st.integers(300, 2000), min_size=1, max_size=5))
def test_a_clock_that_restarts_makes_parts(seed, lengths):
    g = np.random.default_rng(seed)
    parts = [np.sort(g.integers(0, 10**6, n)) + BUFFER_US * k for k, n in enumerate(lengths[::-1])]
    parts = parts[::-1]  # each begins before the one before it
    whole = numbered(np.concatenate(parts))
    for chosen, part in enumerate(parts):
        order = EventSorter(kept_part=chosen)
        assert np.array_equal(taken(order, whole, g)["t"], part)
        assert [one.count for one in order.parts] == lengths and order.dropped == 0
        assert [(one.first_us, one.last_us) for one in order.parts] == [
            (one[0], one[-1]) for one in parts
        ]


@pytest.mark.parametrize("first", [0, 3 * 10**15])
def test_a_wild_first_time_is_no_recording(first):
    times = np.arange(2000) * 100 + 16 * 10**14
    order = EventSorter()
    found = taken(order, numbered([first, *times]), np.random.default_rng(0))
    assert np.array_equal(found["t"], times) and (order.dropped, len(order.parts)) == (1, 1)


def test_a_last_event_after_a_silence_stays_and_a_wild_one_does_not():
    times = np.arange(2000) * 100
    for last, kept in ((900_000, True), (3_600_000_000, False)):
        found = taken(EventSorter(), numbered([*times, last]), np.random.default_rng(0))
        assert (found["t"][-1] == last) == kept and len(found) == 2000 + kept


def test_a_silence_of_years_is_none_of_these():
    order = EventSorter()
    found = taken(order, numbered([0, 1, 10**15, 10**15 + 1]), np.random.default_rng(0))
    assert len(found) == 4 and (order.dropped, len(order.parts)) == (0, 1)


@pytest.mark.parametrize(("gap_us", "parts"), [(3_500_000_000, 1), (3_700_000_000, 2)])
def test_what_comes_after_an_hour_is_another_part(gap_us, parts):
    times = np.arange(1000) * 100
    whole = np.concatenate([times, times + times[-1] + gap_us])
    order = EventSorter()
    found = taken(order, numbered(whole), np.random.default_rng(0))
    assert (len(order.parts), order.dropped) == (parts, 0)
    assert np.array_equal(found["t"], whole if parts == 1 else times)


def test_frames_that_go_pixel_by_pixel_are_given_a_buffer_that_holds_them():
    g = np.random.default_rng(0)
    for frame_us in (33_000, 200_000, 1_000_000):
        frames = [g.integers(0, frame_us, 3000) + k * frame_us for k in range(8)]
        times = np.concatenate(frames)
        pieces = np.array_split(times, 7)
        order = sort_with_smallest_buffer(
            lambda read=pieces: read, len(times), float(np.ptp(times))
        )
        assert 0.99 * frame_us < order.most_late_us <= order.buffer_us < 8 * frame_us
        assert (order.dropped, len(order.parts)) == (0, 1)


def test_a_shuffled_recording_is_refused_with_its_share():
    g = np.random.default_rng(0)
    times = g.permutation(np.arange(20_000) * 5_000)  # 100 s
    with pytest.raises(ValueError, match=r"% of 20000 events are more than .* s out of order"):
        sort_with_smallest_buffer(lambda: [times], len(times), 1e8)


def test_memory_is_bounded_and_what_comes_too_late_is_counted(monkeypatch):
    monkeypatch.setattr("src.recordings.files.event_order.BUFFER_EVENTS", 1000)
    order, times = EventSorter(), np.arange(3000)
    assert sum(map(len, order.add(numbered(times)))) == 2000
    left = [*order.add(numbered([1500, 2500])), *order.finish()]
    assert order.dropped == 1
    assert np.array_equal(np.concatenate(left)["t"], np.sort([*times[2000:], 2500]))


def test_two_recordings_are_merged_by_time():
    g = np.random.default_rng(0)
    times = np.sort(g.integers(0, 1000, 500))
    is_one = g.random(500) < 0.3
    pieces = [np.array_split(numbered(times)[mask], 7) for mask in (is_one, ~is_one)]
    merged = np.concatenate(list(merge_in_time(*map(iter, pieces))))
    assert np.array_equal(merged["t"], times) and len(np.unique(merged[["x", "y"]])) <= 500


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 400), few=st.integers(2, 80))
def test_whatever_comes_every_event_is_given_dropped_or_of_another_part(seed, n, few):
    g = np.random.default_rng(seed)
    scale = 10.0 ** g.integers(1, 9)
    walk = np.cumsum(g.normal(0.2, 1, n) * scale)
    times = np.where(g.random(n) < g.random(), walk, g.normal(0, scale * 10, n)).astype(np.int64)
    whole, total = numbered(times), 0
    for part in range(10**6):
        order = EventSorter(min_part_events=few, kept_part=part)
        found = taken(order, whole, np.random.default_rng(seed))
        assert (np.diff(found["t"]) >= 0).all()
        assert len(np.unique(found[["x", "y"]])) == len(found)
        total += len(found)
        if part + 1 >= len(order.parts):
            break
    assert total + order.dropped == n == order.count
