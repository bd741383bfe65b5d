"""What a machine can do and what a frame needs: its arithmetic, a post-processor's time, bytes."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.weak import WeakIdKeyDictionary

from src.models.stopwatch import clock, threads

PEAK_SIDE, PEAK_CHANNELS = 176, 64  # of the convolution that shows what the machine can do
JOULE_PER_MAC = 4.6e-12  # float32, 45 nm (Horowitz, ISSCC 2014): 3.7 pJ multiply, 0.9 pJ add


@torch.no_grad()
def restoration(restorer: nn.Module, side: int, *, count: int = 1, repeats: int = 2) -> float:
    """Return the ms that a post-processor takes for each frame of a long video of `side` pixels.

    Its windows of WINDOW frames overlap by OVERLAP: what two of them share is paid for twice.
    """
    frames = torch.rand(1, restorer.WINDOW, 1, side, side)
    with threads(count):
        took = min(_timed(clock(count), lambda: restorer.restore(frames)) for _ in range(repeats))
    return 1e3 * took / (restorer.WINDOW - restorer.OVERLAP)


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
