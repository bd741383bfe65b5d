"""One pass that makes a decoder's events ours and looks at each of them (numba)."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True)
def adopt(t, x, y, p, width, height, last, out):
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
