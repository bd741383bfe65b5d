"""The first layer of a network as events make it (engines/events_numba.py), and other sums."""

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from src.deploy.engines import events_numba as kernels
from src.deploy.remaining_layers import E2VIDRemainder, SetNetRemainder
from src.models.setnet import REFERENCE_HZ, SUM_TAUS_S, advance_clock

DTYPES = (np.float64, np.int64, np.int64, np.float32, np.int64)  # of t, x, y, p, view


class EventFirstLayer:
    """The map of a first layer that sees stacked grids, from the events of one window.

    `remainder`: the network behind; `padded`: (h, w) of a grid.  `state`: what lives from window to
    window, arrays that no window changes.
    """

    state: tuple[np.ndarray, ...] = ()

    def __init__(
        self, remainder: E2VIDRemainder | SetNetRemainder, padded: tuple[int, int], threads: int = 1
    ):
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
        """Return what `add` gives for no events at the start."""
        t, x, y, p, view = (np.empty(0, dtype) for dtype in DTYPES)
        inputs = self.add(t, x, y, p, view, 0.0, 1.0)
        self.reset()
        return inputs

    def to_frame(self, output: np.ndarray) -> np.ndarray:
        """Return the frame (h, w), padded, of the output of the remaining layers."""
        return output[0, 0].copy()

    def reset(self) -> None:
        self.state = tuple(np.zeros_like(part) for part in self.state)


class SetNetEventFirstLayer(EventFirstLayer):
    """The map of SetNet's voxel kernels, mixtures of its leaky sums, and its clock; with two
    `threads` map and mixtures are made side by side.
    """

    def __init__(self, remainder: SetNetRemainder, padded: tuple[int, int], threads: int = 1):
        super().__init__(remainder, padded)
        self.pool = ThreadPoolExecutor(1) if threads > 1 else None
        rows, columns = self.shape[1:3]
        self.taus_s = np.array(SUM_TAUS_S, np.float32)
        self.code = np.repeat(remainder.code, self.taus_s.size, 1)
        sums = remainder.views * self.taus_s.size, rows, columns
        mixed = 1, rows, columns, self.code.shape[1] + self.taus_s.size  # and the spread
        clock = (2,)  # activity and context recency of SetNetState
        self.state = tuple(np.zeros(size, np.float32) for size in (sums, mixed, clock))

    def add(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        """Bring the state to the end of a window; return the map, mixtures of the sums and their
        spread, the time passed, context recency, and whether an update of the context is due.
        """
        to_rate = np.float32(1 / (REFERENCE_HZ * (t1 - t0)))  # as SetNet counts them
        window = t, x, y, p, view, t0, t1
        if self.pool:
            sums = self.pool.submit(self._add_to_sums, *window)
            made = super().add(t, x, y, to_rate * p, view, t0, t1)
            return [*made, *sums.result()]
        return [*super().add(t, x, y, to_rate * p, view, t0, t1), *self._add_to_sums(*window)]

    def _add_to_sums(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        new = np.zeros((len(self.code), *self.shape[1:3]), np.float32)
        cells, has_events = kernels.count_in_cells(t, x, y, p, view, t0, t1, self.stride, new)
        sums_before, mixed_before, (activity, recency) = self.state
        tick, *clock = advance_clock(has_events, np.float32(t1 - t0), activity, recency, np)
        leak = np.float32(tick.elapsed_s), self.taus_s
        sums, mixed = np.empty_like(sums_before), np.empty_like(mixed_before)
        kernels.leak(*leak, new, sums_before, sums)
        kernels.leak_mixtures(*leak, p, view, cells, self.code, mixed_before[0], mixed[0])
        kernels.write_view_deviation(self.taus_s.size, sums, mixed[0])
        self.state = sums, mixed, np.array(clock, np.float32)
        times = (np.full((1, 1, 1, 1), one, np.float32) for one in tick[:2])
        return [mixed, *times, np.array(tick.update_due)]

    def to_frame(self, output: np.ndarray) -> np.ndarray:
        frame = np.empty([self.stride * side for side in self.shape[1:3]], np.float32)
        kernels.write_cells(output[0], frame)
        return frame


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
