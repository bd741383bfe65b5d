"""The first layer of a network as events make it, one by one, and what else it adds up of them."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np

from src.models.behind_first_layer import AfterHead, AfterStem
from src.models.engines import events_numba as kernels
from src.models.kernel_patches import patches, spans
from src.models.setnet import AWAKE_S, DUE, LOOK_S, MEMORIES_S, RATE

NOTHING = [np.empty(0, kind) for kind in (np.float64, np.int64, np.int64, np.float32, np.int64)]


class HeadFront:
    """The map of a head that sees stacked grids: 45 channels, say, at full resolution."""

    def __init__(self, after: AfterHead | AfterStem, padded: tuple[int, int], threads: int = 1):
        kernel, bias = after.kernel, after.bias
        channels, size, self.stride = len(kernel), kernel.shape[-1], after.stride
        self.table = patches(kernel, after.views, self.stride)
        self.down, self.right = (spans(side, self.stride, size) for side in padded)
        height, width = (side // self.stride for side in padded)
        self.bias, self.shape = np.tile(bias, width), (1, height, width, channels)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        """Return what comes behind is given after a window's events: the map (1, h, w, c)."""
        made = np.empty((self.shape[1], self.bias.size), np.float32)
        made[:] = self.bias
        patch = (self.down, self.right, self.table, self.stride)
        kernels.add_patches(t, x, y, p, view, t0, t1, *patch, made)
        return [made.reshape(self.shape)]

    def example(self) -> list[np.ndarray]:
        """Return what `add` gives for no events at the start."""
        inputs = self.add(*NOTHING, 0.0, 1.0)
        self.reset()
        return inputs

    def frame(self, drawn: np.ndarray) -> np.ndarray:
        """Return the frame (h, w), padded, of what came out behind."""
        return drawn[0, 0].copy()

    def reset(self) -> None:
        """There is nothing to forget."""

    def state(self) -> None:
        """There is none."""

    def restore(self, state: None) -> None:
        """There is none."""


class StemFront(HeadFront):
    """The map of SetNet's stem, in cells, mixtures of its leaky sums and its clock; with two
    `threads` these are made side by side.
    """

    def __init__(self, after: AfterStem, padded: tuple[int, int], threads: int = 1):
        super().__init__(after, padded)
        self.beside = ThreadPoolExecutor(1) if threads > 1 else None
        rows, columns = self.shape[1:3]
        self.memories = np.array(MEMORIES_S, np.float32)
        self.code = np.repeat(after.code, self.memories.size, 1)
        self.sums = np.zeros((after.views * self.memories.size, rows, columns), np.float32)
        mixtures = self.code.shape[1] + self.memories.size  # and the spread
        self.mixed = np.zeros((1, rows, columns, mixtures), np.float32)
        self.clock = np.zeros(2, np.float32)  # how awake it is, how recently it looked around

    def add(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        """Bring the sums to the end of a window; return the map, mixtures of the sums and their
        spread, the time passed, how recently one looked around, and whether to look again.
        """
        often = np.float32(1 / (RATE * (t1 - t0)))  # as SetNet counts them
        sums, mixed = np.empty_like(self.sums), np.empty_like(self.mixed)
        remember = partial(
            kernels.remember, t, x, y, p, view, t0, t1, self.stride, self.memories,
            np.float32(AWAKE_S), self.clock[0], self.code, self.sums, sums, self.mixed[0],
            mixed[0],
        )  # fmt: skip
        if self.beside:
            remember = self.beside.submit(remember).result
        made = super().add(t, x, y, often * p, view, t0, t1)
        awake, passed = remember()
        recent = self.clock[1] * np.float32(np.exp(-passed / LOOK_S))
        due = recent <= DUE and passed > 0
        self.clock[:] = awake, 1 if due else recent
        times = *(np.full((1, 1, 1, 1), one, np.float32) for one in (passed, recent)), np.array(due)
        self.sums, self.mixed = sums, mixed
        return [*made, mixed, *times]

    def frame(self, drawn: np.ndarray) -> np.ndarray:
        """Return the frame (h, w), padded, of its cells."""
        shown = np.empty([self.stride * side for side in self.shape[1:3]], np.float32)
        kernels.spread_out(drawn[0], shown)
        return shown

    def reset(self) -> None:
        """Forget the sums and fall asleep."""
        self.restore([np.zeros_like(part) for part in self.state()])

    def state(self) -> list[np.ndarray]:
        """Return the sums and mixtures, which no window changes, and a copy of the clock."""
        return [self.sums, self.mixed, self.clock.copy()]

    def restore(self, state: list[np.ndarray]) -> None:
        """Go on from what `state` gave."""
        self.sums, self.mixed, self.clock[:] = state
