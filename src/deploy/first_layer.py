"""The first layer of a network as events make it, one by one.

A convolution is linear: an event adds the part of the kernel that reaches from where it fell, its
patch, to the map.
"""

from typing import Any

import numpy as np
from jaxtyping import Float, Int

from src.deploy.engines import events_numba as kernels
from src.deploy.remaining_layers import E2VIDRemainder

DTYPES = (np.float64, np.int64, np.int64, np.float32, np.int64)  # of t, x, y, p, view


class EventFirstLayer:
    """The map of a first layer that sees stacked grids, from the events of one window.

    `remainder`: the network behind; `padded`: (h, w) of a grid.  Nothing lives from window to
    window: `state` is for those of which something does.
    """

    state = None

    def __init__(self, remainder: E2VIDRemainder, padded: tuple[int, int]):
        kernel, self.stride = remainder.kernel, remainder.stride
        channels, size = len(kernel), kernel.shape[-1]
        self.patches = event_patches(kernel, remainder.views, self.stride)
        self.row_spans, self.column_spans = (
            patch_spans(side, self.stride, size) for side in padded
        )
        height, width = (side // self.stride for side in padded)
        self.bias, self.shape = np.tile(remainder.bias, width), (1, height, width, channels)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        """Return the map (1, h, w, c) of a window's events, the input of the remaining layers."""
        made = np.empty((self.shape[1], self.bias.size), np.float32)
        made[:] = self.bias
        patch = (self.row_spans, self.column_spans, self.patches, self.stride)
        kernels.add_patches(t, x, y, p, view, t0, t1, *patch, made)
        return [made.reshape(self.shape)]

    def example(self) -> list[np.ndarray]:
        """Return what `add` gives for no events."""
        t, x, y, p, view = (np.empty(0, dtype) for dtype in DTYPES)
        return self.add(t, x, y, p, view, 0.0, 1.0)

    def reset(self) -> None:
        """Do nothing: there is nothing to forget."""


def event_patches(
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
        top = _first_output(row, stride, half)
        down = [row - stride * (top + i) + half for i in range(reach)]
        for column in range(stride):
            left = _first_output(column, stride, half)
            right = [column - stride * (left + j) + half for j in range(reach)]
            for i, j in np.ndindex(reach, reach):
                if down[i] >= 0 and right[j] >= 0:
                    made[:, :, row, column, i, j] = stacked[:, :, down[i], right[j]]
    return made.reshape(*made.shape[:5], reach * channels)


def patch_spans(side: int, stride: int, size: int) -> Int[np.ndarray, "side 3"]:
    """Return for each place along an axis (first output, first of the patch, how many outputs) of
    a convolution of `size`, padded by size // 2: at the edges a part of the patch falls outside.
    """
    place = np.arange(side)
    first, last = _first_output(place, stride, size // 2), (place + size // 2) // stride
    begin, end = np.maximum(first, 0), np.minimum(last, side // stride - 1)
    return np.stack([begin, begin - first, end - begin + 1], 1)


def _first_output(place: Any, stride: int, half: int) -> Any:
    return -((half - place) // stride)
