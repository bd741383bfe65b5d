"""How long a frame takes and what is needed for it: state carried, after a warm-up.

On one thread the time is what that thread computes (other jobs on the machine hardly disturb it),
else wall time.  docs/results.md says what it was measured on.
"""

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.weak import WeakIdKeyDictionary

from src.models.cost import clock

PEAK_SIDE, PEAK_CHANNELS = 176, 64  # of the convolution that shows what the machine can do
JOULE_PER_MAC = 4.6e-12  # float32, 45 nm (Horowitz, ISSCC 2014): 3.7 pJ multiply, 0.9 pJ add


@dataclass(frozen=True)
class Timing:
    """Milliseconds of a frame, median and least of `frames`, by `clock`: thread or wall."""

    median_ms: float
    least_ms: float
    frames: int
    clock: str


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch compute on `count` threads for as long as this lasts."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.no_grad()
def frame(
    network: nn.Module, voxels: Tensor, *, count: int = 1, seconds: float = 1.0, least: int = 3
) -> Timing:
    """Return the time of one window (n, views, bins, h, w) on `count` threads.

    The second frame warms up too.  As many frames as fit into `seconds`, at least `least`.
    """
    now = clock(count, voxels.device)
    with threads(count):
        state = _advance(network, voxels, None, 2)
        times: list[float] = []
        until = time.perf_counter() + seconds
        while len(times) < least or (time.perf_counter() < until and len(times) < 200):
            start = now()
            state = _advance(network, voxels, state, 1)
            times.append(1e3 * (now() - start))
    times.sort()
    name = "thread" if now is time.thread_time else "wall"
    return Timing(times[len(times) // 2], times[0], len(times), name)


@torch.no_grad()
def restoration(restorer: nn.Module, side: int, *, count: int = 1, repeats: int = 2) -> float:
    """Return the ms that a post-processor takes for each frame of a long video of `side` pixels.

    Its windows of WINDOW frames overlap by OVERLAP: what two of them share is paid for twice.
    """
    frames = torch.rand(1, restorer.WINDOW, 1, side, side)
    with threads(count):
        took = min(_timed(clock(count), lambda: restorer.restore(frames)) for _ in range(repeats))
    return 1e3 * took / (restorer.WINDOW - restorer.OVERLAP)


def _advance(network: nn.Module, voxels: Tensor, state: Any, frames: int) -> Any:
    for _ in range(frames):
        _, state = network(voxels, state)
    if voxels.device.type == "cuda":
        torch.cuda.synchronize(voxels.device)
    return state


@torch.no_grad()
def convolution_peak(dtype: torch.dtype, *, count: int = 1, repeats: int = 8) -> float:
    """Return the multiply-accumulates a second of a large 3x3 convolution, channels-last.

    The best of `repeats` on `count` threads: what no network of convolutions exceeds by much.
    """
    size = (1, PEAK_CHANNELS, PEAK_SIDE, PEAK_SIDE)
    x = torch.randn(size).to(dtype).to(memory_format=torch.channels_last)
    kernel = torch.randn(PEAK_CHANNELS, PEAK_CHANNELS, 3, 3).to(dtype)
    kernel = kernel.to(memory_format=torch.channels_last)
    with threads(count):
        functional.conv2d(x, kernel, padding=1)
        best = min(_timed(clock(count), lambda: functional.conv2d(x, kernel, padding=1))
                   for _ in range(repeats))  # fmt: skip
    return PEAK_SIDE**2 * PEAK_CHANNELS**2 * 9 / best


def _timed(now: Callable[[], float], work: Callable[[], Any]) -> float:
    start = now()
    work()
    return max(now() - start, 1e-9)


class _Live(TorchDispatchMode):
    """Adds up the bytes of the storages that are alive; notes the most there ever were."""

    def __init__(self):
        super().__init__()
        self.seen, self.most = WeakIdKeyDictionary(), 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for part in result if isinstance(result, tuple | list) else [result]:
            if isinstance(part, Tensor):
                storage = part.untyped_storage()
                self.seen[storage] = storage.nbytes()
        self.most = max(self.most, sum(self.seen.values()))
        return result


@torch.no_grad()
def peak_bytes(network: nn.Module, voxels: Tensor) -> int:
    """Return the bytes of the weights and of the most tensors alive at once in one frame.

    Workspaces inside a convolution are not counted.
    """
    weights = sum(p.numel() * p.element_size() for p in network.parameters())
    _, state = network(voxels, None)
    with _Live() as live:
        network(voxels, state)
    return weights + voxels.numel() * voxels.element_size() + live.most
