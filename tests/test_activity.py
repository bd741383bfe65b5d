"""The titles of the benchmark of time against activity."""

import pytest

from benchmarks import activity


@pytest.mark.parametrize(
    ("size", "title"),
    list(
        zip(
            activity.SIZES,
            (
                "9 x 176 x 176, 600 windows/s\n10,800 events a window at 100 %",
                "1 x 640 x 480, 120 windows/s\n90,000 events a window at 100 %",
                "1 x 1280 x 720, 120 windows/s\n276,000 events a window at 100 %",
            ),
            strict=True,
        )
    ),
)
def test_a_size_is_titled_with_its_rate_and_its_events(size, title):
    assert activity.describe_size(*size) == title
