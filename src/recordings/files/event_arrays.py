"""Fast operations on structured arrays of events, which numpy copies field by field."""

from bisect import bisect_left
from collections.abc import Sequence

import numpy as np


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


def contiguous_columns(events: np.ndarray, names: str) -> list[np.ndarray]:
    """Return the fields of `events` of these one-letter `names`, each in an array of its own.

    A field is contiguous where there are less than two events; numba compiles anew for that.
    """
    return [np.ascontiguousarray(events[name]) for name in names]


def sort_events(events: np.ndarray) -> np.ndarray:
    """Return events, or times alone, by time, those of one time in their order."""
    times = np.ascontiguousarray(event_times(events))
    return events.take(np.argsort(times, kind="stable"))
