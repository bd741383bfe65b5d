"""The first layer of a network as events make it, one by one, and what else it adds up of them."""

import numpy as np

from src.models.behind_first_layer import AfterHead, AfterStem
from src.models.engines import events_numba as kernels
from src.models.kernel_patches import patches, spans
from src.models.setnet import AWAKE_S, MEMORIES_S

NOTHING = [np.empty(0, kind) for kind in (np.float64, np.int64, np.int64, np.float32, np.int64)]


class HeadFront:
    """The map of a head that sees stacked grids: 45 channels, say, at full resolution."""

    def __init__(self, after: AfterHead | AfterStem, padded: tuple[int, int]):
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
    """The map of SetNet's stem, in cells, and its leaky sums."""

    def __init__(self, after: AfterStem, padded: tuple[int, int]):
        super().__init__(after, padded)
        rows, columns = (side // self.stride for side in padded)
        count, eighth = len(MEMORIES_S), (padded[0] // 8, padded[1] // 8)
        self.memories = np.array(MEMORIES_S, np.float32)
        self.skip, self.local = after.skip, after.network.local
        self.awake = np.zeros(eighth, np.float32)
        self.sums = np.zeros(((after.views + 1) * count, rows, columns), np.float32)
        self.means = np.zeros((len(self.skip), rows, columns * self.stride**2), np.float32)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> list[np.ndarray]:
        """Bring the sums to the end of a window; return the map, the sums and their spread, the
        time passed, what the sums draw.
        """
        passed, drawn = np.empty_like(self.awake), np.empty(self.means.shape[1:], np.float32)
        kernels.remember(
            t, x, y, p, view, t0, t1, self.memories, np.float32(AWAKE_S),
            self.local, self.awake, passed, self.sums, self.means,
        )  # fmt: skip
        kernels.weigh(self.skip, self.means, drawn)
        return [
            *super().add(t, x, y, p, view, t0, t1),
            self.sums[None].copy(),
            passed[None, None],
            drawn.reshape(*self.shape[:3], -1),
        ]

    def frame(self, drawn: np.ndarray) -> np.ndarray:
        """Return the frame (h, w), padded, of its cells."""
        shown = np.empty([self.stride * side for side in self.shape[1:3]], np.float32)
        kernels.spread_out(drawn[0], shown)
        return shown

    def reset(self) -> None:
        """Forget the sums and fall asleep."""
        self.restore([np.zeros_like(part) for part in self.state()])

    def state(self) -> list[np.ndarray]:
        """Return a copy of the sums, the mean view's and how awake each block is."""
        return [part.copy() for part in (self.sums, self.means, self.awake)]

    def restore(self, state: list[np.ndarray]) -> None:
        """Go on from what `state` gave."""
        for own, part in zip((self.sums, self.means, self.awake), state, strict=True):
            own[:] = part
