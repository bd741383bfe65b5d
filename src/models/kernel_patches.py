"""Which part of a convolution's kernel an event adds to its map, and where.

A convolution is linear: an event adds the part of the kernel that reaches from where it fell.
"""

import numpy as np
from jaxtyping import Float, Int


def patches(
    kernel: Float[np.ndarray, "c viewsbins k k"], views: int, stride: int
) -> Float[np.ndarray, "views bins stride stride reach reachc"]:
    """Return what an event adds to the map: [view, bin, row % stride, column % stride], first row
    first, and in a row first column first, each with all its channels.
    """
    channels, _, size, _ = kernel.shape
    stacked = kernel.reshape(channels, views, -1, size, size).transpose(1, 2, 3, 4, 0)
    reach, half = -(-size // stride), size // 2
    made = np.zeros((*stacked.shape[:2], stride, stride, reach, reach, channels), np.float32)
    for row in range(stride):
        # An output at `first + i` sees the event at row - stride * (first + i) + half.
        top = _first(row, stride, half)
        down = [row - stride * (top + i) + half for i in range(reach)]
        for column in range(stride):
            left = _first(column, stride, half)
            right = [column - stride * (left + j) + half for j in range(reach)]
            for i, j in np.ndindex(reach, reach):
                if down[i] >= 0 and right[j] >= 0:
                    made[:, :, row, column, i, j] = stacked[:, :, down[i], right[j]]
    return made.reshape(*made.shape[:5], reach * channels)


def spans(side: int, stride: int, size: int) -> Int[np.ndarray, "side 3"]:
    """Return for each place along an axis (first output, first of the patch, how many outputs) of
    a convolution of `size`, padded by size // 2: at the edges a part of the patch falls outside.
    """
    made, outputs = np.zeros((side, 3), np.int64), side // stride
    for place in range(side):
        first, last = _first(place, stride, size // 2), (place + size // 2) // stride
        begin, end = max(first, 0), min(last, outputs - 1)
        made[place] = begin, begin - first, end - begin + 1
    return made


def _first(place: int, stride: int, half: int) -> int:
    return -((half - place) // stride)
