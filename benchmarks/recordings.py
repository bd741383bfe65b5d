"""Splitting, voxelising and reconstructing a recording: python -m benchmarks.recordings

Goals: 15 million events a second split and voxelised on one thread; 2 GB for any length.
Events are uniform over a 1280x720 sensor with nine views, the worst case for a cache.  Thread time
is the minimum over repeats of one thread's CPU time; end to end it is the process's.
"""

import argparse
import multiprocessing
import resource
import tempfile
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch

from benchmarks.timing import least
from src.app.script import run_script
from src.models.e2vid import E2VID
from src.models.setnet import SetNet
from src.recordings import event_windows, reconstruction, sensor_lookup
from src.recordings.files import event_writers, recording
from src.recordings.files.event_file import EVENT
from src.recordings.simulated_recording import kaleidoscope_views
from src.sim.optics import layout

SENSOR, MODEL = (720, 1280), (176, 176)


def events(count: int, seconds: float, first_us: int = 0) -> np.ndarray:
    """Return uniform events in order of time."""
    rng = np.random.default_rng(first_us)
    made = np.empty(count, EVENT)
    made["t"] = first_us + np.sort(rng.integers(0, int(seconds * 1e6), count))
    made["x"], made["y"] = rng.integers(0, SENSOR[1], count), rng.integers(0, SENSOR[0], count)
    made["p"] = rng.integers(0, 2, count) * 2 - 1
    return made


def table() -> sensor_lookup.SensorLookup:
    """Return the lookup of a kaleidoscope whose views are 176x176."""
    return sensor_lookup.build_lookup(
        kaleidoscope_views(list(layout(9)), model=MODEL, sensor=SENSOR)
    )


def splitting() -> None:
    """Events per second of one thread: one window of 2 million events into nine grids."""
    views, made = table(), events(2_000_000, 1 / 120)
    grid = views.empty_grid(5)
    for nearest in (False, True):
        seconds = least(lambda near=nearest: views.add_to_grid(made, grid, 0, 8333, nearest=near))
        kind = "nearest" if nearest else "bilinear"
        print(f"split + voxelise, {kind}, one thread: {len(made) / seconds / 1e6:.1f} Mev/s")


def end_to_end(path: Path, seconds: float) -> None:
    """Times real time of one thread's CPU time, from the file to pictures, at 120 and 600 fps."""
    torch.set_num_threads(1)
    views = table()
    networks = {
        "E2VID base 8": E2VID(views=9, base_channels=8),
        "SetNet small": SetNet.preset("small"),
    }
    warm = event_windows.WindowRule(fps=120, end_s=0.02)  # compiles
    for net in networks.values():
        chunks = recording.iter_events(path, seconds=0.05)
        parts = event_windows.cut_windows(chunks, views, warm)
        assert list(reconstruction.reconstruct_frames(parts, net.eval()))
    for (name, net), fps in product(networks.items(), (120, 600)):
        length = seconds if fps == 120 else min(seconds, 1.0)
        rule, start = event_windows.WindowRule(fps=fps, end_s=length), time.process_time()
        chunks = recording.iter_events(path, seconds=0.05)
        parts, frames, events = event_windows.cut_windows(chunks, views, rule), 0, 0
        for frame in reconstruction.reconstruct_frames(parts, net.eval()):
            frames, events = frames + 1, events + frame.events + frame.events_outside
        cpu = time.process_time() - start
        print(
            f"file to {frames} frames, {fps} fps, {name}, one thread:"
            f" {length / cpu:.2f} x real time, {events / cpu / 1e6:.1f} Mev/s"
        )


def main() -> None:
    """Print everything; a process of its own reads the file, so that its memory is known."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    splitting()
    with tempfile.TemporaryDirectory() as folder:
        path, count, seconds = Path(folder) / "long.raw", 20_000_000, 4.0
        event_writers.write_events(path, events(count, seconds), width=SENSOR[1], height=SENSOR[0])
        reader = multiprocessing.get_context("spawn").Process(
            target=end_to_end, args=(path, seconds)
        )
        reader.start()
        reader.join()
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 2**20
        print(f"peak memory of the process that read {count:,} events: {peak:.2f} GB")


if __name__ == "__main__":
    run_script(main)
