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


@njit(nogil=True, cache=True)
def count_in_cells(t, x, y, p, view, t0, t1, side, new):
    """Add the events with t0 <= t <= t1 to `new` (views, hc, wc); return the cell of each, counted
    row by row, or -1, and whether `new` has any.
    """
    cells, flat = np.full(t.size, -1), new.reshape(-1)
    width, count, side = np.uint64(new.shape[2]), new.shape[1] * new.shape[2], np.uint64(side)
    for i in range(t.size):
        if t0 <= t[i] <= t1:
            cells[i] = np.uint64(y[i]) // side * width + np.uint64(x[i]) // side
            flat[np.uint64(view[i] * count + cells[i])] += p[i]
    return cells, new.any()


@njit(nogil=True, cache=True)
def leak(elapsed_s, taus_s, new, before, sums):
    """Write exp(-elapsed_s / taus_s) * before + new into `sums`, (views * taus, hc, wc); `new`:
    (views, hc, wc).
    """
    decay = np.exp(-elapsed_s / taus_s)
    for m in range(decay.size):
        for v in range(new.shape[0]):
            for r in range(new.shape[1]):
                k = v * decay.size + m
                row, old, more = sums[k, r], before[k, r], new[v, r]
                for c in range(np.uint64(row.size)):
                    row[c] = old[c] * decay[m] + more[c]


@njit(nogil=True, cache=True)
def leak_mixtures(elapsed_s, taus_s, p, view, cells, code, before, mixed):
    """Let the mixtures leak, and add the events that fell into cells, as `leak` their sums."""
    decay, decays = np.exp(-elapsed_s / taus_s), np.empty(mixed.shape[1] * mixed.shape[2], f32)
    for c in range(decays.size):
        decays[c] = decay[c % decay.size]
    for r in range(mixed.shape[0]):
        row, old = mixed[r].reshape(-1), before[r].reshape(-1)
        for c in range(np.uint64(row.size)):
            row[c] = old[c] * decays[c]
    to, shares, n = mixed.reshape(-1), code.reshape(-1), np.uint64(code.shape[1])
    for i in range(p.size):
        if cells[i] >= 0:
            here, there = np.uint64(cells[i] * mixed.shape[2]), np.uint64(view[i]) * n
            for k in range(n):
                to[here + k] += p[i] * shares[there + k]


@njit(nogil=True, cache=True)
def write_view_deviation(taus, sums, mixed):
    """Write the mean distance of the views' sums from their mean behind their mixtures."""
    views, behind = sums.shape[0] // taus, mixed.shape[2] - taus
    middle, part = np.empty(sums.shape[2], f32), f32(1) / f32(views)
    far = np.empty_like(middle)
    for m in range(taus):
        for r in range(sums.shape[1]):
            middle[:] = 0
            for v in range(views):
                row = sums[v * taus + m, r]
                for c in range(np.uint64(row.size)):
                    middle[c] += row[c] * part
            far[:] = 0
            for v in range(views):
                row = sums[v * taus + m, r]
                for c in range(np.uint64(row.size)):
                    far[c] += abs(row[c] - middle[c]) * part
            mixed[r, :, behind + m] = far


@njit(nogil=True, cache=True)
def write_cells(cells, frame):
    """Write (hc, wc, pixels), the pixels of each cell, into `frame` (h, w)."""
    side = frame.shape[0] // cells.shape[0]
    for r in range(cells.shape[0]):
        for k in range(side):
            row = frame[side * r + k]
            for c in range(np.uint64(cells.shape[1])):
                for q in range(side):
                    row[side * c + q] = cells[r, c, side * k + q]
