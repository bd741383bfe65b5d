"""The stopwatch of every network: how long a frame takes, state carried, after a warm-up."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from src.models.unroll import accepted
from src.sim.optics import Position


def clock(threads: int, device: torch.device | str = "cpu") -> Callable[[], float]:
    """Return the clock, in seconds, of every timing of a network: on one thread of a CPU what that
    thread computes, which other jobs on the machine hardly disturb, else wall time.
    """
    alone = threads == 1 and torch.device(device).type == "cpu"
    return time.thread_time if alone else time.perf_counter


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
    network: nn.Module,
    voxels: Tensor,
    *,
    positions: Sequence[Position] | None = None,
    count: int = 1,
    seconds: float = 1.0,
    least: int = 3,
) -> Timing:
    """Return the time of one window (n, views, bins, h, w) on `count` threads.

    `positions`: (row, col) of each view, None: `optics.layout`.  The second frame warms up too.  As
    many frames as fit into `seconds`, at least `least`.
    """
    now, options = clock(count, voxels.device), accepted(network, positions=positions)
    with threads(count):
        state = _advance(network, voxels, None, 2, options)
        times: list[float] = []
        until = time.perf_counter() + seconds
        while len(times) < least or (time.perf_counter() < until and len(times) < 200):
            start = now()
            state = _advance(network, voxels, state, 1, options)
            times.append(1e3 * (now() - start))
    times.sort()
    name = "thread" if now is time.thread_time else "wall"
    return Timing(times[len(times) // 2], times[0], len(times), name)


def _advance(network: nn.Module, voxels: Tensor, state: Any, frames: int, options: dict) -> Any:
    for _ in range(frames):
        _, state = network(voxels, state, **options)
    if voxels.device.type == "cuda":
        torch.cuda.synchronize(voxels.device)
    return state
