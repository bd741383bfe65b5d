"""From a list of events to the inputs of a network's first layer, without a grid (numba).

A convolution is linear, so that an event adds to the map of the first layer the part of the kernel
that reaches from where it fell: what a window costs follows its events.
"""

import numpy as np
from numba import njit

f32 = np.float32


@njit(nogil=True, cache=True)
def has_event_error(t, x, y, p, view, views, height, width, is_sign):
    """Return whether an event has no finite t or p, comes before the one before it, lies off the
    sensor or in no view, or, where p `is_sign`, has a p other than -1 and 1.
    """
    wrong = False
    for i in range(np.uint64(t.size)):  # without a way out, which would keep it from vectors
        wrong |= not abs(t[i]) < np.inf or not abs(p[i]) < f32(np.inf)
        wrong |= x[i] < 0 or x[i] >= width or y[i] < 0 or y[i] >= height
        wrong |= view[i] < 0 or view[i] >= views or (is_sign and abs(p[i]) != f32(1))
    for i in range(np.uint64(1), np.uint64(t.size)):
        wrong |= t[i] < t[i - np.uint64(1)]
    return wrong


@njit(nogil=True, cache=True)
def add_patches(t, x, y, p, view, t0, t1, row_spans, column_spans, patches, out):
    """Add all events with t0 <= t <= t1 to `out` (h, w * c), weighed in time as `voxel_grid`.

    `patches`, `row_spans`, `column_spans`: of `src.deploy.first_layer`, for a stride of 1.
    """
    bins, reach, wide = patches.shape[1], patches.shape[4], patches.shape[5]
    channels, pitch = wide // reach, out.shape[1]
    flat, to = patches.reshape(-1), out.reshape(-1)
    each = reach * wide
    scale = f32(f32(bins - 1) / f32(t1 - t0))
    for i in range(t.size):
        if not t0 <= t[i] <= t1:
            continue
        tau = f32(f32(t[i] - t0) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        row, column = row_spans[y[i]], column_spans[x[i]]
        k = (view[i] * bins + b) * each + row[1] * wide + column[1] * channels
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
