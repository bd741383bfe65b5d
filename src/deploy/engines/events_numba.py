"""From a list of events to the inputs of a network's first layer, without a grid (numba).

A convolution is linear, so that an event adds to the map of the first layer the part of the kernel
that reaches from where it fell: what a window costs follows its events.
"""

import numpy as np
from numba import njit

f32 = np.float32

GOOD, BACKWARDS, OFF_SENSOR, NO_VIEW, NO_NUMBER, NO_SIGN = range(6)  # what `check` finds


@njit(nogil=True, cache=True)
def find_bad_event(t, x, y, p, view, views, height, width, signs):
    """Return (index, what) of the first event that is wrong, or (-1, GOOD); of `signs`, p is one
    of -1 and 1.
    """
    wrong = False
    for i in range(np.uint64(t.size)):  # without a way out, which would keep it from vectors
        wrong |= not abs(t[i]) < np.inf or not abs(p[i]) < f32(np.inf)
        wrong |= x[i] < 0 or x[i] >= width or y[i] < 0 or y[i] >= height
        wrong |= view[i] < 0 or view[i] >= views or (signs and abs(p[i]) != f32(1))
    for i in range(np.uint64(1), np.uint64(t.size)):
        wrong |= t[i] < t[i - np.uint64(1)]
    if not wrong:
        return -1, GOOD
    for i in range(t.size):
        if not np.isfinite(t[i]) or not np.isfinite(p[i]):
            return i, NO_NUMBER
        if i and t[i] < t[i - 1]:
            return i, BACKWARDS
        if not (0 <= x[i] < width and 0 <= y[i] < height):
            return i, OFF_SENSOR
        if not 0 <= view[i] < views:
            return i, NO_VIEW
        if signs and abs(p[i]) != 1:
            return i, NO_SIGN
    return -1, GOOD


@njit(nogil=True, cache=True)
def add_patches(t, x, y, p, view, t0, t1, row_spans, column_spans, patches, stride, out):
    """Add all events with t0 <= t <= t1 to `out` (h2, w2 * c), weighed in time as `voxel_grid`.

    `patches`, `row_spans`, `column_spans`: of `src.deploy.first_layer`.
    """
    bins, reach, wide = patches.shape[1], patches.shape[4], patches.shape[5]
    channels, pitch = wide // reach, out.shape[1]
    flat, to = patches.reshape(-1), out.reshape(-1)
    phase = reach * wide
    each = stride * stride * phase
    scale = f32(f32(bins - 1) / f32(t1 - t0))
    for i in range(t.size):
        if not t0 <= t[i] <= t1:
            continue
        tau = f32(f32(t[i] - t0) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        row, column = row_spans[y[i]], column_spans[x[i]]
        k = (view[i] * bins + b) * each + ((y[i] % stride) * stride + x[i] % stride) * phase
        k += row[1] * wide + column[1] * channels
        after = each if b + 1 < bins else 0
        o = row[0] * pitch + column[0] * channels
        early, late = p[i] * (f32(1) - late), p[i] * late
        n = np.uint64(column[2] * channels)
        for _ in range(row[2]):
            here, one, two = np.uint64(o), np.uint64(k), np.uint64(k + after)
            for q in range(n):
                to[here + q] += early * flat[one + q] + late * flat[two + q]
            o += pitch
            k += wide
