"""Fast operations on structured arrays of events, which numpy copies field by field."""

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np

from src.recordings.engines.event_passes import sort_slightly_late

MOVES = 8  # of each event, beyond which sorting by insertion is slow


def concatenate_events(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Return the events of `parts`, each contiguous; of a single part itself, not a copy."""
    if len(parts) == 1:
        return parts[0]
    return np.concatenate([part.view(np.uint8) for part in parts]).view(parts[0].dtype)


def event_times(events: np.ndarray) -> np.ndarray:
    """Return the times of events, or times alone as they are."""
    return events["t"] if events.dtype.names else events


def count_before(events: np.ndarray, time_us: float) -> int:
    """Return how many of `events`, or times alone, in order of time, come before `time_us`."""
    return bisect_left(event_times(events), time_us)


def sort_events(events: np.ndarray) -> np.ndarray:
    """Return events, or times alone, by time, those of one time in their order."""
    times = event_times(events)
    t, order = np.array(times, np.int64), np.arange(len(events))
    if sort_slightly_late(t, order, MOVES * len(t)):
        moved, by_time = np.flatnonzero(order != np.arange(len(order))), events.copy()
        by_time[moved] = events[order[moved]]
        return by_time
    return events[np.argsort(times, kind="stable")]
