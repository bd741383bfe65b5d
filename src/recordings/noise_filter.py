"""Events that no neighbour supports: background activity (Delbruck 2008) and hot pixels."""

import math

import numpy as np

from src.recordings.engines.support import LONG_AGO, support
from src.recordings.views import Size


class NoiseFilter:
    """Keeps an event if one of its eight neighbours, of the same view or not, had one, ON or OFF,
    at most `seconds` before; the pixel itself does not count.

    `sensor`: (height, width).  It remembers what came before from call to call.  Raises ValueError
    unless `seconds` is above 0.
    """

    def __init__(self, sensor: Size, seconds: float):
        if not 0 < seconds < math.inf:
            raise ValueError(f"noise_filter_s must be > 0 seconds or null, got {seconds}")
        height, width = sensor
        self.latest = np.full((height + 2, width + 2), LONG_AGO)  # with a border
        self.within = round(1e6 * seconds)

    def __call__(self, events: np.ndarray) -> np.ndarray:
        """Return those of `events` (t x y p), in order of time, that are kept."""
        kept = np.empty(len(events), bool)
        support(events["t"], events["x"], events["y"], self.latest, self.within, kept)
        return events[kept]
