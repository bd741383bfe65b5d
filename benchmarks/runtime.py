"""From a list of events to a frame in memory: python -m benchmarks.runtime

Limits (two threads, nine views of 176x176, 600 fps, 5 million events a second over all views):
setnet_small 1.67 ms, setnet_medium 3.4 ms, median.  Events are those of a real recording, its
sensor cut into nine views, its clock set so that they come at that rate.  After it PyTorch from
the same lists: grids, then the network.  All is in bf16 where the processor is faster in it, else
in float32 (what a wide SetNet draws: in bytes).  On one thread the time is what the process
computes, which other jobs disturb less, else wall time.  Each is in a process of its own, as it
would be live.
"""

import argparse
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from benchmarks.timing import RECORDING
from src.app.script import positive_number, run_script, whole_number
from src.bench.speed import FORM_DTYPES, build_grid_step, measure_peak_conv_macs_per_s
from src.deploy.cost import count_macs, macs_per_frame, torch_threads
from src.deploy.cpu_features import is_bf16_faster
from src.deploy.forms import convert_to_form
from src.deploy.runtime import EventListRuntime
from src.models.files import load
from src.recordings.files.recording import read_events
from src.sim.optics import layout

SIDE, FPS, RATE = 176, 600, 5e6
NAMES = ("setnet_small", "setnet_medium", "lf3x3")


def windows(path: Path) -> list[tuple]:
    """Return (t, x, y, p, view, t0, t1) of each window; the sensor's nine tiles are the views."""
    events = read_events(path)
    height, width = int(events["y"].max()) + 1, int(events["x"].max()) + 1
    across, down = (3.0 * events["x"] / width), (3.0 * events["y"] / height)
    view = 3 * down.astype(int) + across.astype(int)
    x, y = (SIDE * (across % 1)).astype(np.uint16), (SIDE * (down % 1)).astype(np.uint16)
    t = (events["t"] - events["t"][0]) * 1e-6
    t *= len(t) / RATE / t[-1]
    made = []
    for k in range(int(t[-1] * FPS)):
        first, stop = np.searchsorted(t, [k / FPS, (k + 1) / FPS])
        fields = (part[first:stop] for part in (t, x, y, events["p"], view))
        made.append((*fields, k / FPS, (k + 1) / FPS))
    return made


def milliseconds(
    step: Callable, played: list[tuple], seconds: float, clock: Callable[[], float]
) -> list[float]:
    """Return the times of `step` over `seconds`, after a first round."""
    times: list[float] = []
    for window in played:
        step(*window)
    until = time.perf_counter() + seconds
    while time.perf_counter() < until:
        for window in played:
            start = clock()
            step(*window)
            times.append(1e3 * (clock() - start))
    return times


def arithmetic(live: EventListRuntime, played: list[tuple]) -> float:
    """Return the multiply-accumulates, in G, of a window behind the first layer, mean of `played`,
    as some windows take more than others.
    """
    return count_macs(lambda: [live.step(*window) for window in played]) / len(played) / 1e9


def line(name: str, times: list[float], giga: float, peak: float) -> str:
    """Return median and mean and what share of the machine's peak the arithmetic is."""
    median, mean, times = statistics.median(times), statistics.mean(times), sorted(times)
    low, high = times[len(times) // 10], times[9 * len(times) // 10]
    rate = giga / mean * 1e3
    share = f"{rate:5.0f} GMAC/s, {rate / peak:.0%} of a peak of {peak:.0f}"
    return f"{name:32s} {median:6.2f} ms ({low:.2f} to {high:.2f}), mean {mean:.2f}  {share}"


def measured(
    name: str, engine: str, form: str, count: int, played: list[tuple], seconds: float
) -> str:
    """Return the line of a network on `engine`, openvino or pytorch, and `count` threads; PyTorch
    computes in `form`, float32 or bf16."""
    peak = measure_peak_conv_macs_per_s(FORM_DTYPES[form], threads=count) / 1e9
    network = load(name)
    size = {"positions": layout(9), "height": SIDE, "width": SIDE}
    if engine == "openvino":
        giga = arithmetic(EventListRuntime(network, **size, form="float32"), played[:10])
        step = EventListRuntime(network, **size, threads=count, form="openvino").step
    else:
        giga = macs_per_frame(network, SIDE, SIDE, views=9) / 1e9
        fast = convert_to_form(network, form)
        step = build_grid_step(fast, 9, SIDE, SIDE, window_s=1 / FPS)
    clock = time.process_time if count == 1 else time.perf_counter
    with torch_threads(count):
        times = milliseconds(step, played, seconds, clock)
    return line(f"{name}, {engine}", times, giga, peak)


def main() -> None:
    """Print a line for each number of threads, network and engine, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=NAMES)
    parser.add_argument("--recording", type=Path, default=RECORDING)
    parser.add_argument("--threads", type=whole_number, nargs="+", default=[1, 2])
    parser.add_argument("--seconds", type=positive_number, default=4.0)
    given = parser.parse_args()
    played, form = windows(given.recording), "bf16" if is_bf16_faster() else "float32"
    mean = statistics.mean(len(window[0]) for window in played)
    print(f"{len(played)} windows of 1/{FPS} s, {mean:.0f} events each over nine views of {SIDE}")
    for count in given.threads:
        kind = "CPU" if count == 1 else "wall"
        print(f"threads: {count}, {kind} time, median (10 to 90 %), convolutions in {form}")
        for name, engine in product(given.names, ("openvino", "pytorch")):
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
                told = alone.submit(measured, name, engine, form, count, played, given.seconds)
                print(told.result(), flush=True)


if __name__ == "__main__":
    run_script(main)
