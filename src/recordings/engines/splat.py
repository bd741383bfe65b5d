"""One pass over a list of events: look up the view, add to its voxel grid or list what to add."""

import numpy as np
from numba import njit

BATCH = 256  # events that are looked up before any is used


@njit(nogil=True, cache=True)
def splat_and_count_outside(t, x, y, p, view, model_xy, grid, t0, t1, nearest):
    """Add events to `grid` (views, bins, h, w) in their order; return how many were in no view.

    `t`, and `t0` and `t1`, the edges of the window, in us; `view` and `model_xy` of `SensorLookup`.
    In time the weight is E2VID's hat on bins - 1 intervals (Rebecq et al. 2019, eq. 1); in space
    bilinear, or 1 at the nearest pixel.  Places are clamped to the grid, so that no mass is lost.
    """
    _, bins, height, width = grid.shape
    rate = (bins - 1) / (t1 - t0)
    outside = 0
    for i in range(t.size):
        index = view[y[i], x[i]]
        if index < 0:
            outside += 1
            continue
        tau = min(max((t[i] - t0) * rate, 0.0), bins - 1.0)
        b = min(int(tau), max(bins - 2, 0))
        late = tau - b
        u = min(max(model_xy[y[i], x[i], 0], 0.0), width - 1.0)
        v = min(max(model_xy[y[i], x[i], 1], 0.0), height - 1.0)
        if nearest:
            u, v = float(int(u + 0.5)), float(int(v + 0.5))
        c, r = int(u), int(v)
        right, down = u - c, v - r
        for k in range(2):
            weight = p[i] * (late if k else 1.0 - late)
            if weight == 0.0:
                continue
            plane = grid[index, b + k]
            plane[r, c] += weight * (1.0 - right) * (1.0 - down)
            if right > 0.0:
                plane[r, c + 1] += weight * right * (1.0 - down)
            if down > 0.0:
                plane[r + 1, c] += weight * (1.0 - right) * down
            if right > 0.0 and down > 0.0:
                plane[r + 1, c + 1] += weight * right * down
    return outside


@njit(nogil=True, cache=True)
def list_bilinear_contributions(x, y, p, view, model_xy, density, index, u, v, which, weight):
    """List what `splat_and_count_outside` adds, bilinearly: for each part the index of its event,
    its pixel (u, v), its view and its weight over `density` (views, h, w); return the number of
    parts and of events in no view.
    """
    _, height, width = density.shape
    outside = parts = 0
    for i in range(x.size):
        k = view[y[i], x[i]]
        if k < 0:
            outside += 1
            continue
        right = min(max(model_xy[y[i], x[i], 0], 0.0), width - 1.0)
        down = min(max(model_xy[y[i], x[i], 1], 0.0), height - 1.0)
        c, r = int(right), int(down)
        right, down = right - c, down - r
        for a in range(2):
            for b in range(2):
                part = (down if a else 1.0 - down) * (right if b else 1.0 - right)
                if part > 0.0:
                    index[parts], u[parts], v[parts], which[parts] = i, c + b, r + a, k
                    weight[parts] = p[i] * part / density[k, r + a, c + b]
                    parts += 1
    return parts, outside


@njit(nogil=True, cache=True)
def list_nearest_contributions(x, y, p, nearest, density, index, u, v, which, weight):
    """As `list_bilinear_contributions`, at `nearest`: SensorLookup.nearest_model_pixel."""
    _, height, width = density.shape
    flat = density.reshape(-1)
    pixels, densities = np.empty(BATCH, np.int64), np.empty(BATCH, np.float32)
    outside = parts = 0
    for begin in range(0, x.size, BATCH):
        count = min(BATCH, x.size - begin)
        _look_up(x, y, begin, count, nearest, pixels)
        for i in range(count):
            densities[i] = flat[max(pixels[i], 0)]
        for i in range(count):
            pixel = pixels[i]
            if pixel < 0:
                outside += 1
                continue
            row = pixel // width
            index[parts], u[parts], v[parts] = begin + i, pixel - row * width, row % height
            which[parts], weight[parts] = row // height, p[begin + i] / densities[i]
            parts += 1
    return parts, outside


@njit(nogil=True, cache=True)
def count_polarity(x, y, p, nearest, counts):
    """Add the polarity of every event to `counts` (views, h, w); `nearest` as above."""
    flat, pixels = counts.reshape(-1), np.empty(BATCH, np.int64)
    for begin in range(0, x.size, BATCH):
        count = min(BATCH, x.size - begin)
        _look_up(x, y, begin, count, nearest, pixels)
        for i in range(count):
            if pixels[i] >= 0:
                flat[pixels[i]] += p[begin + i]


@njit(nogil=True, cache=True)
def _look_up(x, y, begin, count, nearest, pixels):
    """Look up the pixels of `count` events and nothing else: their waits for memory overlap."""
    for i in range(count):
        pixels[i] = nearest[y[begin + i], x[begin + i]]
