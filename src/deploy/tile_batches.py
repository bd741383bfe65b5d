"""A module on any number of tiles: in batches of a few fixed sizes, the last one filled up; and
PyTorch as what computes it.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from src.deploy.cost import torch_threads

CALL_COST = 8  # what a call costs beside its tiles, in tiles
Backend = Callable[[nn.Module, list[Tensor], int], Any]  # EagerBackend or CompiledModule


@lru_cache(4096)
def choose_batch_sizes(tiles: int, sizes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the sizes of the batches, of `sizes`, in which `tiles` take least time."""
    if tiles <= 0:
        return ()
    if tiles > 2 * sizes[-1]:
        return sizes[-1], *choose_batch_sizes(tiles - sizes[-1], sizes)
    ways = [(size, *choose_batch_sizes(tiles - size, sizes)) for size in sizes]
    return min(ways, key=lambda way: sum(way) + CALL_COST * len(way))


class EagerBackend:
    """A module on PyTorch: arrays and a state in, an array and a state out."""

    def __init__(self, module: nn.Module, example: list[Tensor], threads: int):
        self.module = module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.example, self.threads = example, threads

    @torch.inference_mode()
    def __call__(self, inputs: list[np.ndarray], state: list[Tensor]) -> list:
        with torch_threads(self.threads):
            output, *state = self.module(*map(torch.from_numpy, inputs), *state)
        return [output.numpy(), *state]

    @torch.inference_mode()
    def run(self, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        """Write the outputs of a module that takes no state: arrays, contiguous and float32."""
        with torch_threads(self.threads):
            made = self.module(*map(torch.from_numpy, inputs))
        for part, output in zip(made if isinstance(made, tuple) else (made,), outputs, strict=True):
            output[...] = part.numpy()

    def zeros(self, first: int) -> list[Tensor]:
        return [torch.zeros_like(part) for part in self.example[first:]]


class TileModule:
    """`module`, which has one output, on batches of tiles; `shapes`: of an input for one tile;
    `sizes`: of the batches, in tiles, ascending."""

    def __init__(
        self,
        module: nn.Module,
        shapes: Sequence[tuple[int, ...]],
        backend: Backend,
        threads: int,
        sizes: tuple[int, ...],
    ):
        self.sizes = sizes
        self.compiled, self.inputs, self.outputs = {}, {}, {}
        for size in sizes:
            example = [torch.zeros(size, *shape, dtype=torch.float32) for shape in shapes]
            with torch.inference_mode():
                self.outputs[size] = [module(*example).numpy().copy()]
            self.inputs[size] = [part.numpy() for part in example]
            self.compiled[size] = backend(module, example, threads)

    def run(
        self,
        tiles: int,
        read: Callable[[slice, list[np.ndarray]], None],
        write: Callable[[slice, np.ndarray], None],
    ) -> None:
        """Run on all `tiles`: read(which, inputs) fills the inputs of a batch, write(which, output)
        takes its output."""
        start = 0
        for size in choose_batch_sizes(tiles, self.sizes):
            part = slice(start, min(start + size, tiles))
            read(part, self.inputs[size])
            self.compiled[size].run(self.inputs[size], self.outputs[size])
            write(part, self.outputs[size][0])
            start += size
