"""Time of a window against where events fall: python -m benchmarks.activity

One line for each network and size: milliseconds, the median of some windows, with events in 0, 5,
10, 25, 50, 75 and 100 % (rounded up to whole ones) of the tiles of 32 x 32 pixels, a block around
the middle, 300 events a window in each, over all views.  `--figure FILE` draws them.
"""

import argparse
import math
import statistics
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.runtime import milliseconds
from src.app.script import positive_number, run_script, whole_number
from src.deploy.runtime import EventListRuntime, fastest_form
from src.figures import plots
from src.models.files import load
from src.sim.optics import layout

TILE_PX, EVENTS = 32, 300  # side of a tile, events in each over all views
SIZES = ((9, 176, 176, 600.0), (1, 480, 640, 120.0), (1, 720, 1280, 120.0))  # views, h, w, rate
SHARES = (0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)


def block(share: float, height: int, width: int) -> list[tuple[int, int]]:
    """Return the corners, in pixels, of the tiles nearest to the middle that are `share` of all."""
    corners = [(y, x) for y in range(0, height, TILE_PX) for x in range(0, width, TILE_PX)]
    middle = (height - TILE_PX) / 2, (width - TILE_PX) / 2
    corners.sort(key=lambda at: max(abs(at[0] - middle[0]), abs(at[1] - middle[1])))
    return corners[: math.ceil(share * len(corners))]


def windows(share: float, views: int, height: int, width: int, fps: float, count: int) -> list:
    """Return (t, x, y, p, view, t0, t1) of `count` windows."""
    rng, corners, made = np.random.default_rng(0), block(share, height, width), []
    for k in range(count):
        places = np.repeat(np.array(corners, int).reshape(-1, 2), EVENTS, 0)
        inside = np.minimum(TILE_PX, (height, width) - places)  # of a tile that the border cuts
        places += (inside * rng.random(places.shape)).astype(int)
        n, edges = len(places), (k / fps, (k + 1) / fps)
        y, x = places[rng.permutation(n)].T
        p, view = 2 * rng.integers(0, 2, n) - 1, rng.integers(0, views, n)
        made.append((np.sort(rng.uniform(*edges, n)), x, y, p, view, *edges))
    return made


def covered_share(share: float, height: int, width: int) -> float:
    """Return the share of the tiles that `block` gives."""
    return len(block(share, height, width)) / len(block(1.0, height, width))


def describe_size(views: int, height: int, width: int, fps: float) -> str:
    """Return the title of a size: the views, the rate, and the events of a window at 100 %."""
    most = EVENTS * len(block(1.0, height, width))
    return f"{views} x {width} x {height}, {fps:.0f} windows/s\n{most:,} events a window at 100 %"


def draw(path: Path, measured: dict[tuple[str, str], dict[float, float]]) -> None:
    """Draw milliseconds against the share, a panel for each size and a line for each network."""
    sizes = list(dict.fromkeys(size for _, size in measured))
    figure = Figure(figsize=(3.2 * len(sizes), 2.8), layout="constrained")
    panels = figure.subplots(1, len(sizes), squeeze=False)[0]
    for size, axes in zip(sizes, panels, strict=True):
        for (name, its_size), times in measured.items():
            if its_size == size:
                percent = [100 * share for share in times]
                axes.plot(percent, list(times.values()), marker="o", label=name)
        axes.set(title=size, xlabel="share of the frame with events, %", ylim=(0, None))
    panels[0].set_ylabel("ms a window")
    panels[0].legend(frameon=False)
    plots.save_figure(figure, path)


def main() -> None:
    """Print the lines."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", default=("setnet_small", "setnet_medium"))
    parser.add_argument("--threads", type=whole_number, default=2)
    parser.add_argument("--seconds", type=positive_number, default=1.0)
    parser.add_argument("--windows", type=whole_number, default=24)
    parser.add_argument("--figure", type=Path, help="a file for the figure, .png or .svg")
    given = parser.parse_args()
    form, measured = fastest_form(), {}
    print(f"{form}, {given.threads} threads; share of the tiles: ms")
    for name in given.names:
        network = load(name)
        for views, height, width, fps in SIZES:
            how = {"positions": layout(views), "height": height, "width": width}
            live = EventListRuntime(network, **how, threads=given.threads, form=form)
            found: dict[float, float] = {}
            for share in SHARES:
                live.reset()
                played = windows(share, views, height, width, fps, given.windows)
                times = milliseconds(live.step, played, given.seconds, time.perf_counter)
                found[covered_share(share, height, width)] = statistics.median(times)
            size = describe_size(views, height, width, fps)
            line = (f"{share:.0%}: {ms:.2f}" for share, ms in found.items())
            print(f"{name}, {size.splitlines()[0]}:", ", ".join(line), flush=True)
            measured[name, size] = found
    if given.figure:
        draw(given.figure, measured)


if __name__ == "__main__":
    run_script(main)
