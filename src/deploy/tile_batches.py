"""A module on any number of tiles: in batches of a few fixed sizes, the last one filled up."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

CALL_COST = 4  # what a call costs beside its tiles, in tiles
Backend = Callable[[nn.Module, list[Tensor], int], Any]  # EagerBackend or CompiledModule


@lru_cache(4096)
def split_into_batches(tiles: int, sizes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the sizes of the batches, of `sizes`, in which `tiles` take least time."""
    if tiles <= 0:
        return ()
    if tiles > 2 * sizes[-1]:
        return sizes[-1], *split_into_batches(tiles - sizes[-1], sizes)
    ways = [(size, *split_into_batches(tiles - size, sizes)) for size in sizes]
    return min(ways, key=lambda way: sum(way) + CALL_COST * len(way))


class Workers:
    """The threads that take batches of tiles side by side: as many as `threads`, at most two, if
    modules of the `backend` run so."""

    def __init__(self, backend: Any, threads: int):
        self.count = min(threads, 2) if backend.RUNS_SIDE_BY_SIDE else 1
        self.backend, self.threads = backend, threads
        self.pool = ThreadPoolExecutor(1) if self.count > 1 else None

    def compile(self, module: nn.Module, example: list[Tensor]) -> list[Any]:
        """Return `module`, compiled for each of them."""
        each = self.threads // self.count
        return [self.backend(module, example, each) for _ in range(self.count)]

    def share(self, work: Callable[[int], None], parts: int) -> None:
        """Call work(0) and, where there are parts for both, work(1) in the other thread, which each
        take parts until there are none: what the other has not begun then is left out."""
        other = self.pool.submit(work, 1) if self.pool and parts > 1 else None
        work(0)
        if other and not other.cancel():
            other.result()


class TileModule:
    """`module`, which has one output, on batches of tiles; `shapes`: of an input for one tile;
    `sizes`: of the batches, in tiles, ascending."""

    def __init__(
        self,
        module: nn.Module,
        shapes: Sequence[tuple[int, ...]],
        workers: Workers,
        sizes: tuple[int, ...],
    ):
        self.sizes, self.workers = sizes, workers
        self.compiled, self.inputs, self.outputs = {}, {}, {}
        for size in sizes:
            example = [torch.zeros(size, *shape) for shape in shapes]
            with torch.inference_mode():
                made = module(*example).numpy()
            for k, compiled in enumerate(workers.compile(module, example)):
                self.compiled[size, k] = compiled
                self.inputs[size, k] = [np.zeros(part.shape, np.float32) for part in example]
                self.outputs[size, k] = [made.copy()]

    def run(
        self,
        tiles: int,
        read: Callable[[slice, list[np.ndarray]], None],
        write: Callable[[slice, np.ndarray], Any],
    ) -> list:
        """Run on all `tiles`: read(which, inputs) fills the inputs of a batch, write(which, output)
        takes its output.  Return what the calls of `write` do."""
        sizes = split_into_batches(tiles, self.sizes)
        made = [None] * len(sizes)
        stops = accumulate(sizes)
        todo = iter([*zip(range(len(sizes)), sizes, stops, strict=True)])  # shared by the workers

        def work(worker: int) -> None:
            for k, size, stop in todo:
                part, which = slice(stop - size, min(stop, tiles)), (size, worker)
                read(part, self.inputs[which])
                self.compiled[which].run(self.inputs[which], self.outputs[which])
                made[k] = write(part, self.outputs[which][0])

        self.workers.share(work, len(sizes))
        return made
