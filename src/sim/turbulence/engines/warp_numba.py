"""Cubic warp of frames on the CPU.

Own code: cubic maps of OpenCV have a = -3/4 and places rounded to 1/32 pixel.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numba import njit
from torch import Tensor

MARGIN = 16  # pixels of a frame's reflection around it
HALF, ONE, TWO, THREE, FOUR, FIVE = (np.float32(number) for number in (0.5, 1, 2, 3, 4, 5))


class PaddedFrames(NamedTuple):
    """Frames with a margin of their reflection, and `low` and `high`, each one's range."""

    frames: Float[np.ndarray, "frames height width"]
    low: Float[np.ndarray, " frames"]
    high: Float[np.ndarray, " frames"]


def pad_frames(frames: Float[Tensor, "frames height width"]) -> PaddedFrames:
    """Return the frames of a clip for `warp_frames`."""
    margin, values = (MARGIN,) * 2, frames.numpy()
    padded = np.pad(values, ((0, 0), margin, margin), mode="symmetric")
    return PaddedFrames(padded, values.min((1, 2)), values.max((1, 2)))


def warp_frames(
    padded: PaddedFrames, first: int, tilt: Float[Tensor, "xy=2 n h w"], top: int, left: int
) -> Iterator[Float[np.ndarray, "h w"]]:
    """Yield the frames from `first` on, displaced by `tilt` (x, y) in pixels: see warp_frame."""
    for index in range(tilt.shape[1]):
        frame, low, high = (part[first + index] for part in padded)
        yield warp_frame(frame, tilt.numpy(), index, top, left, low, high)


@njit(nogil=True, cache=True, fastmath=True)
def warp_frame(frame, tilt, index, top, left, low, high):
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
    total, across, down = np.float32(0.0), _taps(x), _taps(y)
    for i in range(4):
        row, line = _reflect(r + i - 1, frame.shape[0]), np.float32(0.0)
        for j in range(4):
            line += across[j] * frame[row, _reflect(c + j - 1, frame.shape[1])]
        total += down[i] * line
    return total


@njit(nogil=True, inline="always")
def _reflect(index, size):
    """Return where in a padded frame, of `size` with both margins, the pixel `index` is found."""
    own = size - 2 * MARGIN
    folded = (index - MARGIN) % (2 * own)
    return MARGIN + min(folded, 2 * own - 1 - folded)
