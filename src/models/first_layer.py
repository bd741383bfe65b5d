"""The first layer of a network as events make it, one by one, and what else it adds up of them."""

import numpy as np

from src.models.after import AfterHead, AfterStem
from src.models.engines import events_numba as kernels
from src.models.patches import patches, spans
from src.models.setnet import AWAKE_S, MEMORIES_S


class HeadFront:
    """The map of a head that sees stacked grids: 45 channels, say, at full resolution."""

    def __init__(self, after: AfterHead | AfterStem, padded: tuple[int, int]):
        kernel, bias = after.kernel, after.bias
        channels, size, self.stride = len(kernel), kernel.shape[-1], after.stride
        self.table = patches(kernel, after.views, self.stride)
        self.down, self.right = (spans(side, self.stride, size) for side in padded)
        height, width = (side // self.stride for side in padded)
        self.bias = np.tile(bias, width)
        self.map = np.zeros((height, width * channels), np.float32)
        self.shape = (1, height, width, channels)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> None:
        """Make the map of a window's events."""
        self.map[:] = self.bias
        kernels.add_patches(
            t, x, y, p, view, t0, t1, self.down, self.right, self.table, self.stride, self.map
        )

    def inputs(self) -> list[np.ndarray]:
        """Return what comes behind is given: the map (1, h, w, c)."""
        return [self.map.reshape(self.shape)]

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
    """The map of SetNet's stem at half resolution, and its leaky sums."""

    def __init__(self, after: AfterStem, padded: tuple[int, int]):
        super().__init__(after, padded)
        h2, w2 = padded[0] // 2, padded[1] // 2
        count, eighth = len(MEMORIES_S), (padded[0] // 8, padded[1] // 8)
        self.memories = np.array(MEMORIES_S, np.float32)
        self.skip = after.skip
        self.coarse = np.zeros((after.views, h2, w2), np.float32)
        self.awake, self.passed = np.zeros(eighth, np.float32), np.zeros(eighth, np.float32)
        self.sums = np.zeros(((after.views + 1) * count, h2, w2), np.float32)
        self.means = np.zeros((count, h2, 4 * w2), np.float32)
        self.drawn = np.zeros((h2, 4 * w2), np.float32)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> None:
        """Make the map of a window's events and bring the sums to its end."""
        super().add(t, x, y, p, view, t0, t1)
        kernels.remember(
            t, x, y, p, view, t0, t1, self.memories, np.float32(AWAKE_S), self.coarse,
            self.awake, self.passed, self.sums, self.means,
        )  # fmt: skip
        kernels.weigh(self.skip, self.means, self.drawn)

    def inputs(self) -> list[np.ndarray]:
        """Return the map, sums and their spread, the time passed, what the sums draw."""
        height, width = self.drawn.shape[0], self.drawn.shape[1] // 4
        return [
            *super().inputs(),
            self.sums[None],
            self.passed[None, None],
            self.drawn.reshape(1, height, width, 4),
        ]

    def frame(self, drawn: np.ndarray) -> np.ndarray:
        """Return the frame (h, w), padded, of its blocks of four pixels."""
        shown = np.empty((2 * drawn.shape[1], 2 * drawn.shape[2]), np.float32)
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
