"""Cubic warp of a frame on the CPU."""

import numpy as np
from numba import njit

MARGIN = 16  # pixels of a frame's reflection around it
HALF, ONE, TWO, THREE, FOUR, FIVE = (np.float32(number) for number in (0.5, 1, 2, 3, 4, 5))


@njit(nogil=True, cache=True, fastmath=True)
def warp(frame, tilt, index, top, left, low, high):
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    `frame` has MARGIN pixels of its reflection on every side; `tilt` (2, frames, h, w) is (x, y) in
    pixels, of which the one at `index` counts; Keys' cubic (a = -1/2), held within `low` and
    `high`, the frame's range.  Farther out lies more of the reflection.
    """
    height, width = tilt.shape[2:]
    rows, columns = frame.shape
    out, flat = np.empty((height, width), np.float32), frame.ravel()
    x, y = np.empty((2, width), np.float32)
    c, r = np.empty((2, width), np.int32)
    for i in range(height):
        line = out[i]
        _split(tilt[0, index, i], np.int32(left + MARGIN), np.int32(1), c, x)
        _split(tilt[1, index, i], np.int32(i + top + MARGIN), np.int32(0), r, y)
        if r.min() < 1 or c.min() < 1 or r.max() + 2 >= rows or c.max() + 2 >= columns:
            for j in range(width):
                line[j] = min(max(_far(frame, r[j], c[j], y[j], x[j]), low), high)
            continue
        for j in range(width):
            a, b = x[j], y[j]
            k = (r[j] - 1) * columns + c[j] - 1
            a0, a1, a2, a3 = _taps(a)
            b0, b1, b2, b3 = _taps(b)
            total = b0 * (a0 * flat[k] + a1 * flat[k + 1] + a2 * flat[k + 2] + a3 * flat[k + 3])
            k += columns
            total += b1 * (a0 * flat[k] + a1 * flat[k + 1] + a2 * flat[k + 2] + a3 * flat[k + 3])
            k += columns
            total += b2 * (a0 * flat[k] + a1 * flat[k + 1] + a2 * flat[k + 2] + a3 * flat[k + 3])
            k += columns
            total += b3 * (a0 * flat[k] + a1 * flat[k + 1] + a2 * flat[k + 2] + a3 * flat[k + 3])
            line[j] = min(max(total, low), high)
    return out


@njit(nogil=True, fastmath=True, inline="always")
def _split(tilt, first, step, whole, rest):
    """Write the pixel before the place that is seen along one axis, and how far it lies behind."""
    for j in range(len(tilt)):
        away = -tilt[j]
        down = np.floor(away)
        rest[j] = away - down
        whole[j] = np.int32(down) + first + step * np.int32(j)


@njit(nogil=True, fastmath=True, inline="always")
def _taps(t):
    half = HALF * t
    return (
        half * (t * (TWO - t) - ONE),
        ONE + half * t * (THREE * t - FIVE),
        half * (t * (FOUR - THREE * t) + ONE),
        half * t * (t - ONE),
    )


@njit(nogil=True, fastmath=True)
def _far(frame, r, c, y, x):
    """Return what lies behind the pixel (`r`, `c`) of `frame`, wherever it is."""
    total, across = np.float32(0.0), _taps(x)
    columns = _four(c, frame.shape[1])
    for row, down in zip(_four(r, frame.shape[0]), _taps(y)):  # noqa: B905 numba
        line = np.float32(0.0)
        for column, share in zip(columns, across):  # noqa: B905 numba
            line += share * frame[row, column]
        total += down * line
    return total


@njit(nogil=True, inline="always")
def _four(k, size):
    """Return where the pixels k - 1 .. k + 2 are found, `size` with both margins."""
    own, k = size - 2 * MARGIN, k - MARGIN
    return (
        MARGIN + _reflect(k - 1, own),
        MARGIN + _reflect(k, own),
        MARGIN + _reflect(k + 1, own),
        MARGIN + _reflect(k + 2, own),
    )


@njit(nogil=True, inline="always")
def _reflect(index, size):
    folded = index % (2 * size)
    return min(folded, 2 * size - 1 - folded)
