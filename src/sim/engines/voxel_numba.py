"""One pass over a list of events into one voxel grid (numba)."""

import numpy as np
from numba import njit

f32 = np.float32


@njit(nogil=True, cache=True)
def accumulate(t, x, y, p, t0, t1, scale, zero_is_off, grid):
    """Add the events with t0 <= t <= t1 to `grid`; return the index of a bad event, or -1."""
    bins, height, width = grid.shape
    for i in range(t.size):
        if not (0 <= x[i] < width and 0 <= y[i] < height):
            return i
        if p[i] == 1:
            sign = f32(1)
        elif p[i] == -1 or (p[i] == 0 and zero_is_off):
            sign = f32(-1)
        else:
            return i
        if not t0 <= t[i] <= t1:
            continue
        tau = f32(f32(t[i] - t0) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        grid[b, y[i], x[i]] += sign * (f32(1) - late)
        if late > 0 and b + 1 < bins:
            grid[b + 1, y[i], x[i]] += sign * late
    return -1
