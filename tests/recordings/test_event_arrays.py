"""Arrays of events are joined and cut as numpy would."""

import numpy as np
import pytest

from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.files.event_file import EVENT


def events(count: int) -> np.ndarray:
    made, rng = np.zeros(count, EVENT), np.random.default_rng(count)
    made["t"] = np.sort(rng.integers(0, 40, count))
    made["x"], made["p"] = rng.integers(0, 2**16, count), rng.choice([-1, 1], count)
    return made


@pytest.mark.parametrize("counts", [(5,), (0,), (3, 0, 7), (0, 0), (100, 50)])
def test_joined_as_numpy_does(counts):
    parts = [events(count)[count // 3 :] for count in counts]
    whole = concatenate_events(parts)
    assert whole.dtype == EVENT and np.array_equal(whole, np.concatenate(parts))


@pytest.mark.parametrize("count", [0, 1, 100])
def test_until_counts_what_comes_before(count):
    some = events(count)
    for time in (-1.0, 0, 7, 7.5, 39, 1e9):
        assert count_before(some, time) == np.searchsorted(some["t"], time)
