"""Cubic warp of a frame on the CPU."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def warp(frame, tilt, index, top, left):
    """Return frame(x - tilt(x)) over the window whose first pixel is (`top`, `left`).

    `tilt` (2, frames, h, w) is (x, y) in pixels, of which the one at `index` counts; Keys' cubic
    (a = -1/2), held within the frame's own range; outside the frame lies its reflection.
    """
    height, width = tilt.shape[2:]
    rows, columns = frame.shape
    low, high = frame.min(), frame.max()
    out = np.empty((height, width), np.float32)
    across, down = np.empty(4, np.float32), np.empty(4, np.float32)
    row, column = np.empty(4, np.int64), np.empty(4, np.int64)
    for i in range(height):
        for j in range(width):
            y, x = i + top - tilt[1, index, i, j], j + left - tilt[0, index, i, j]
            r, c = int(np.floor(y)), int(np.floor(x))
            _taps(np.float32(y - r), down)
            _taps(np.float32(x - c), across)
            inside = r >= 1 and c >= 1 and r + 2 < rows and c + 2 < columns
            for k in range(4):
                row[k] = r + k - 1 if inside else _reflect(r + k - 1, rows)
                column[k] = c + k - 1 if inside else _reflect(c + k - 1, columns)
            total = np.float32(0.0)
            for k in range(4):
                total += down[k] * (
                    across[0] * frame[row[k], column[0]]
                    + across[1] * frame[row[k], column[1]]
                    + across[2] * frame[row[k], column[2]]
                    + across[3] * frame[row[k], column[3]]
                )
            out[i, j] = min(max(total, low), high)
    return out


@njit(nogil=True, fastmath=True, inline="always")
def _taps(t, taps):
    half = np.float32(0.5) * t
    taps[0] = half * (t * (np.float32(2.0) - t) - np.float32(1.0))
    taps[1] = np.float32(1.0) + half * t * (np.float32(3.0) * t - np.float32(5.0))
    taps[2] = half * (t * (np.float32(4.0) - np.float32(3.0) * t) + np.float32(1.0))
    taps[3] = half * t * (t - np.float32(1.0))


@njit(nogil=True, inline="always")
def _reflect(index, size):
    folded = index % (2 * size)
    return min(folded, 2 * size - 1 - folded)
