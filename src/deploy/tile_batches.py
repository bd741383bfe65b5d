"""A module on any number of tiles: in batches of a few fixed sizes, the last one filled up."""

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

SIZES = (4, 16)  # of a batch, in tiles
CALL_COST = 2  # what a call costs more than its tiles, in tiles


@lru_cache(4096)
def split_into_batches(tiles: int) -> tuple[int, ...]:
    """Return the sizes of the batches, of SIZES, that `tiles` take least time in."""
    largest = SIZES[-1]
    if tiles > 2 * largest:
        return largest, *split_into_batches(tiles - largest)
    if tiles <= 0:
        return ()
    ways = [(size, *split_into_batches(tiles - size)) for size in SIZES]
    return min(ways, key=lambda way: sum(way) + CALL_COST * len(way))


def padded_count(tiles: int) -> int:
    """Return how many tiles the batches of `tiles` have."""
    return sum(split_into_batches(tiles))


class TileModule:
    """`module` on batches of tiles, on a `backend`; `shapes`: of an input for one tile."""

    def __init__(
        self,
        module: nn.Module,
        shapes: Sequence[tuple[int, ...]],
        backend: Callable[[nn.Module, list[Tensor], int], Any],
        threads: int,
    ):
        self.compiled, self.inputs, self.outputs = {}, {}, {}
        for size in SIZES:
            example = [torch.zeros(size, *shape) for shape in shapes]
            with torch.inference_mode():
                self.outputs[size] = module(*example).numpy().copy()
            self.inputs[size] = [part.numpy() for part in example]
            self.compiled[size] = backend(module, example, threads)

    def batches(self, tiles: int) -> Iterator[tuple[slice, int, list[np.ndarray]]]:
        """Yield for each batch which of `tiles` are in it, its size, and arrays for its inputs."""
        start = 0
        for size in split_into_batches(tiles):
            yield slice(start, min(start + size, tiles)), size, self.inputs[size]
            start += size

    def run(self, size: int, inputs: Sequence[np.ndarray]) -> np.ndarray:
        """Return the output, valid until the next run."""
        self.compiled[size].run(inputs, self.outputs[size])
        return self.outputs[size]
