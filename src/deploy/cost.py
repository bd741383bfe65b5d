"""What a network costs: multiply-accumulates and time of one frame, state carried."""

import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode, sdpa_flop_count

from src.models.network import EventToVideoNetwork
from src.sim.optics import Position

MAX_FRAMES = 200  # timed at most
TIMED_FRAMES = 5  # by `time_frame`
LONG_S = 0.1  # a window in which everything is due


def _count_attention_flops(
    query: torch.Size, key: torch.Size, value: torch.Size, *_: Any, **__: Any
) -> int:
    return sdpa_flop_count(query, key, value)


# The fused attention of a CPU, which torch's FLOP counter leaves out.
CPU_ATTENTION = {torch.ops.aten._scaled_dot_product_flash_attention_for_cpu: _count_attention_flops}


@torch.no_grad()
def macs_per_frame(
    network: EventToVideoNetwork, height: int, width: int, *, views: int = 1, bins: int = 5,
    positions: Sequence[Position] | None = None,
) -> int:  # fmt: skip
    """Return the multiply-accumulates of one window, batch 1, by `count_macs`: of one that takes
    most, with events in every pixel and so long that all that is due at intervals is due.

    `positions`: (row, col) of each view, None: `optics.layout`.
    """
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    voxels = torch.ones(1, views, bins, height, width, device=device)
    _, state = network(voxels, None, positions=positions)
    return count_macs(lambda: network(voxels, state, window_s=LONG_S, positions=positions))


def count_macs(work: Callable[[], object]) -> int:
    """Return the multiply-accumulates of convolutions and matrix products, those of attention
    included, in a call of `work` (torch's FLOP counter, two FLOPs a MAC), on every device the same,
    without elementwise work and interpolation.
    """
    with FlopCounterMode(display=False, custom_mapping=CPU_ATTENTION) as counter:
        work()
    return counter.get_total_flops() // 2


class Timing(NamedTuple):
    """Milliseconds of a frame, median and least of `frames`."""

    median_ms: float
    least_ms: float
    frames: int
    clock: Literal["thread", "wall"]


def select_timing_clock(threads: int, device: torch.device | str = "cpu") -> Callable[[], float]:
    """Return the clock, in seconds, of every timing of a network: on one thread of a CPU what that
    thread computes, which other jobs on the machine hardly disturb, else wall time.
    """
    alone = threads == 1 and torch.device(device).type == "cpu"
    return time.thread_time if alone else time.perf_counter


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch compute on `count` threads for as long as this lasts."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@torch.no_grad()
def time_calls(
    work: Callable[[], object],
    *,
    threads: int = 1,
    device: torch.device | str = "cpu",
    seconds: float = 1.0,
    min_calls: int = 3,
) -> Timing:
    """Return the time of a call of `work`, which makes a frame on `device`, on `threads` threads.

    As many calls as fit into `seconds`, at least `min_calls`, after two that warm up.
    """
    now, times, is_cuda = select_timing_clock(threads, device), list[float](), "cuda" in str(device)

    def call() -> None:
        work()
        if is_cuda:
            torch.cuda.synchronize(device)

    with torch_threads(threads):
        call()
        call()
        until = time.perf_counter() + seconds
        while len(times) < min_calls or (time.perf_counter() < until and len(times) < MAX_FRAMES):
            start = now()
            call()
            times.append(1e3 * (now() - start))
    times.sort()
    clock: Literal["thread", "wall"] = "thread" if now is time.thread_time else "wall"
    return Timing(times[len(times) // 2], times[0], len(times), clock)


def time_frame(
    network: EventToVideoNetwork,
    voxels: Tensor,
    *,
    positions: Sequence[Position] | None = None,
    threads: int = 1,
) -> Timing:
    """Return the time of one window (n, views, bins, h, w), state carried, as `time_calls` does, of
    TIMED_FRAMES.

    `positions`: (row, col) of each view, None: `optics.layout`.
    """
    state: Any = None

    def advance() -> None:
        nonlocal state
        _, state = network(voxels, state, positions=positions)

    return time_calls(
        advance, threads=threads, device=voxels.device, seconds=0.0, min_calls=TIMED_FRAMES
    )
