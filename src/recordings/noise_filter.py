"""Events that no neighbour supports: background activity (Delbruck 2008) and hot pixels."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool

from src.recordings.engines.event_passes import LONG_AGO_US, mark_supported_events
from src.recordings.files.event_arrays import contiguous_columns
from src.recordings.views import HeightWidth

LONGEST_S = 1e6
SUPPORT_S = 0.005  # of `find_supported_pixels`


def check_noise_filter_s(seconds: float) -> None:
    """Raise ValueError for what no noise filter can look back."""
    if not 0 < seconds <= LONGEST_S:
        raise ValueError(f"noise_filter_s must be in (0, 1e6] seconds or null, got {seconds}")


class NoiseFilter:
    """Keeps an event if one of its eight neighbours, of whatever view and polarity, had one at most
    `support_s` before, in this call or an earlier one.

    `sensor`: (height, width).  Raises ValueError as `check_noise_filter_s` does.
    """

    def __init__(self, sensor: HeightWidth, support_s: float):
        check_noise_filter_s(support_s)
        height, width = sensor
        self.latest_us = np.full((height + 2, width + 2), LONG_AGO_US)  # with a border
        self.support_us = round(1e6 * support_s)

    def reset(self) -> None:
        """Forget earlier events: time starts anew."""
        self.latest_us.fill(LONG_AGO_US)

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return those of `events` (t x y p), in order of time, that are kept.

        Raises ValueError for an event off the sensor.
        """
        kept = np.empty(len(events), bool)
        t, x, y = contiguous_columns(events, "txy")
        wrong = mark_supported_events(t, x, y, self.latest_us, self.support_us, kept)
        if wrong >= 0:
            height, width = (side - 2 for side in self.latest_us.shape)
            place = f"x={events['x'][wrong]}, y={events['y'][wrong]}"
            raise ValueError(f"events must be on the {width}x{height} sensor, got {place}")
        return events[kept]


def find_supported_pixels(
    pieces: Iterable[np.ndarray], sensor: HeightWidth
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels that had an event a NoiseFilter of SUPPORT_S keeps."""
    has_events, keep = np.zeros(sensor, bool), NoiseFilter(sensor, SUPPORT_S)
    for kept in map(keep, pieces):
        has_events[kept["y"], kept["x"]] = True
    return has_events
