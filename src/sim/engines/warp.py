"""Cubic warp of a frame on the CPU."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def warp(frame, tilt, top, left):
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    `tilt` (2, h, w) is (x, y) in pixels; Keys' cubic (a = -1/2), held within the frame's own range;
    outside the frame lies its reflection.
    """
    height, width = tilt.shape[1:]
    rows, columns = frame.shape
    low, high = frame.min(), frame.max()
    out = np.empty((height, width), np.float32)
    across = np.empty(4, np.float32)
    for i in range(height):
        for j in range(width):
            y, x = i + top - tilt[1, i, j], j + left - tilt[0, i, j]
            r, c = int(np.floor(y)), int(np.floor(x))
            _taps(np.float32(x - c), across)
            inside = r >= 1 and c >= 1 and r + 2 < rows and c + 2 < columns
            v = np.float32(y - r)
            total = np.float32(0.0)
            for k in range(4):
                line = frame[r + k - 1 if inside else _reflect(r + k - 1, rows)]
                part = np.float32(0.0)
                for m in range(4):
                    column = c + m - 1 if inside else _reflect(c + m - 1, columns)
                    part += across[m] * line[column]
                total += _tap(v, k) * part
            out[i, j] = min(max(total, low), high)
    return out


@njit(nogil=True, fastmath=True, inline="always")
def _taps(t, taps):
    for k in range(4):
        taps[k] = _tap(t, k)


@njit(nogil=True, fastmath=True, inline="always")
def _tap(t, k):
    if k == 0:
        return np.float32(0.5) * t * (t * (np.float32(2.0) - t) - np.float32(1.0))
    if k == 1:
        return np.float32(1.0) + np.float32(0.5) * t * t * (np.float32(3.0) * t - np.float32(5.0))
    if k == 2:
        return np.float32(0.5) * t * (t * (np.float32(4.0) - np.float32(3.0) * t) + np.float32(1.0))
    return np.float32(0.5) * t * t * (t - np.float32(1.0))


@njit(nogil=True, inline="always")
def _reflect(index, size):
    folded = index % (2 * size)
    return min(folded, 2 * size - 1 - folded)
