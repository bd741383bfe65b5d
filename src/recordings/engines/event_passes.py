"""Passes over a list of events that look at each of them: its decoder's faults, its neighbours."""

import numpy as np
from numba import njit

LONG_AGO_US = -(2**62)


@njit(nogil=True, cache=True)
def convert_events(t, x, y, p, width, height, last, out):
    """Fill `out` with the events on the sensor; return (kept, last time, back, outside).

    `p` is ON where positive.  An event earlier than one before it is given that one's time and
    counted as gone back; one outside `width` x `height` (0: not known) is dropped and counted.
    """
    kept = back = outside = 0
    for i in range(t.size):
        if width > 0 and not (0 <= x[i] < width and 0 <= y[i] < height):
            outside += 1
            continue
        now = np.int64(t[i])
        if now < last:
            back += 1
            now = last
        last = now
        out[kept].t, out[kept].x, out[kept].y = now, x[i], y[i]
        out[kept].p = 1 if p[i] > 0 else -1
        kept += 1
    return kept, last, back, outside


@njit(nogil=True, cache=True)
def find_supported(t, x, y, latest_us, support_us, kept):
    """Write to `kept` which events are supported, and their times to `latest_us` (h + 2, w + 2)."""
    for i in range(t.size):
        row, column = y[i] + 1, x[i] + 1
        own = latest_us[row, column]
        latest_us[row, column] = LONG_AGO_US
        newest = LONG_AGO_US
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                newest = max(newest, latest_us[r, c])
        kept[i] = t[i] - newest <= support_us
        latest_us[row, column] = max(own, t[i])
