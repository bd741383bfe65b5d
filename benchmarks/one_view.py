"""One view of a whole sensor, from a list of events to a frame: python -m benchmarks.one_view

Ours run from lists of events, in the form that `src.deploy.runtime.fastest_form` names; the
networks of conf/networks/published.yaml from a grid, each in the fastest of its forms: float32 and,
where the processor is faster in it, bf16 on PyTorch and, with the extra, OpenVINO.  Weights of the
latter are random: time does not depend on them.  Events are those of a real recording, its sensor
scaled to the size, its clock set so that a window of 1/120 s has one event for ten pixels.  Wall
time: of each window the least of several passes, which other jobs on the machine disturb less, and
the median of the windows, as a SetNet's time follows what moves.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from benchmarks.timing import RECORDING
from src.app.instantiate import instantiate_node
from src.app.script import positive_number, run_script, whole_number
from src.bench.speed import build_grid_step
from src.deploy import openvino_network
from src.deploy.cost import torch_threads
from src.deploy.cpu_features import is_bf16_faster
from src.deploy.forms import convert_to_form
from src.deploy.runtime import EventListRuntime, fastest_form
from src.models.files import load
from src.recordings.files.recording import read_events

FPS, EVENTS_PER_PIXEL, WARMUP = 120, 0.1, 2
WINDOWS, PASSES = 3, 3  # at least
SLOW_MS = 8e3  # a frame: no further windows and forms are timed
NETWORKS = Path(__file__).resolve().parents[1] / "conf" / "networks" / "published.yaml"
OURS = ("setnet_small", "setnet_medium", "single256")
SIZES = ("240x180", "346x260", "1280x720")
Window = tuple  # t in s, x, y, p, view, t0, t1


def cut_windows(path: Path, width: int, height: int) -> list[Window]:
    """Return the windows of the recording at `path`, its sensor scaled to `width` x `height`."""
    events = read_events(path)
    x, y = (
        (events[axis] * (side / (float(events[axis].max()) + 1))).astype(np.uint16)
        for axis, side in (("x", width), ("y", height))
    )
    number = int(EVENTS_PER_PIXEL * width * height)
    made, view = [], np.zeros(number, np.uint8)
    for first in range(0, max(len(events) - number, 1), number):
        part, k = slice(first, first + number), len(made)
        own = (events["t"][part] - events["t"][first]).astype(float)
        t = (k + own / (own[-1] + 1)) / FPS
        fields = t, x[part], y[part], events["p"][part], view[: len(t)]
        made.append((*fields, k / FPS, (k + 1) / FPS))
    return made


def window_ms(step: Callable, windows: Sequence[Window], seconds: float) -> float:
    """Return the median over windows of the least time of PASSES through them; as many windows as
    fit into `seconds`, at least WINDOWS.  After a warm-up, whose last time is returned where it is
    above SLOW_MS: the first window compiles.
    """

    def timed(window: Window) -> float:
        start = time.perf_counter()
        step(*window)
        return 1e3 * (time.perf_counter() - start)

    warm = [timed(window) for window in windows[:WARMUP]][-1]
    if warm > SLOW_MS:
        return warm
    count = max(WINDOWS, int(1e3 * seconds / (PASSES * warm)))
    passes = [[timed(window) for window in windows[:count]] for _ in range(PASSES)]
    return statistics.median(map(min, zip(*passes, strict=True)))


def list_forms() -> list[str]:
    """Return the forms that may be the fastest on this machine."""
    with torch_threads(1):  # other jobs disturb that less
        half = ["bf16"] if is_bf16_faster() else []
    return ["float32", *half, *(["openvino"] if openvino_network.is_installed() else [])]


def measure(name: str, size: str, path: Path, threads: int, seconds: float) -> str:
    """Return the milliseconds of a frame of the network `name` and its fastest form."""
    width, height = map(int, size.split("x"))
    windows, found = cut_windows(path, width, height), {}
    forms = list_forms()
    with torch_threads(threads):
        if name in OURS:
            size_px = {"height": height, "width": width, "threads": threads}
            live = EventListRuntime(load(name), positions=[(0, 0)], **size_px)
            return f"{window_ms(live.step, windows, seconds):.1f} {fastest_form()}"
        network = instantiate_node(OmegaConf.load(NETWORKS)[name].model).eval()
        for form in forms:
            try:
                fast = convert_to_form(network, form)
                step = build_grid_step(fast, 1, height, width, window_s=1 / FPS)
                found[form] = window_ms(step, windows, seconds)
            except ValueError as error:  # OpenVINO cannot express it
                print(f"{name}, {form}: {error}", file=sys.stderr)
            if max(found.values(), default=0.0) > SLOW_MS:
                break
    form = min(found, key=found.__getitem__)
    return f"{found[form]:.1f} {form}"


def main() -> None:
    """Print a row for each network, a column for each size."""
    parser = argparse.ArgumentParser(description=__doc__)
    published = [str(name) for name in OmegaConf.load(NETWORKS)]
    parser.add_argument("names", nargs="*", default=[*OURS, *published])
    parser.add_argument("--sizes", nargs="+", default=SIZES, help="width x height in pixels")
    parser.add_argument("--recording", type=Path, default=RECORDING)
    parser.add_argument("--threads", type=whole_number, default=2)
    parser.add_argument(
        "--seconds", type=positive_number, default=2.0, help="of each size and form"
    )
    given = parser.parse_args()
    print("| ms a frame | " + " | ".join(given.sizes) + " |")
    print("|---|" + "---:|" * len(given.sizes))
    options = given.recording, given.threads, given.seconds
    for name in given.names:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as alone:
            cells = [alone.submit(measure, name, size, *options).result() for size in given.sizes]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    run_script(main)
