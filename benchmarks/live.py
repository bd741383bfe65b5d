"""The live chain at full load, page and a visitor included: python -m benchmarks.live

Goals, with setnet_small on nine views of 176x176, 600 windows and 5 million events a second, for 60
s, which two cores without AMX do not reach (docs/live.md): no window dropped; from the end of a
window to its frame in the page's buffer 5 ms in the median, 10 ms at 99 %; the page at 30 pictures
a second 5 % of a core. Events are uniform over the views of a 1280x720 sensor, the worst case for a
cache.
"""

import argparse
import asyncio
import resource
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from benchmarks.recordings import MODEL, SENSOR, events
from src.app.script import positive_number, run_script, whole_number
from src.live import GIL_SWITCH_S, assemble_server
from src.live_view import event_feeds
from src.live_view.network_runner import RunSettings
from src.live_view.page_server import PageServer
from src.live_view.status import FaultLog
from src.models import files
from src.recordings import sensor_lookup
from src.recordings.files import event_writers
from src.recordings.simulated_recording import kaleidoscope_views
from src.sim.optics import layout

RATE = 5_000_000  # events a second over all views
LENGTH_S = 2.0  # of the recording, which is played round and round
WARM_S = 3.0  # before anything is counted
PORT = 8611


def write(path: Path, views) -> None:
    """Write LENGTH_S of RATE events a second, all inside the views."""
    seen = sensor_lookup.build_lookup(views).view >= 0
    drawn = events(int(RATE * LENGTH_S / seen.mean() * 1.01), LENGTH_S)
    inside = drawn[seen[drawn["y"], drawn["x"]]]
    keep = np.sort(np.random.default_rng(0).permutation(len(inside))[: int(RATE * LENGTH_S)])
    event_writers.write_events(path, inside[keep], width=SENSOR[1], height=SENSOR[0])


async def measure(server: PageServer, seconds: float) -> dict:
    """Play and serve for `seconds` after WARM_S with a visitor; return what was counted."""
    player, stop = server.page.player, asyncio.Event()
    running_server = asyncio.create_task(server.run(player.start, stop))
    visitor = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "benchmarks.visitor", str(PORT), stdout=asyncio.subprocess.PIPE
    )
    await visitor.stdout.readline()
    await asyncio.sleep(WARM_S)
    meters, waiting = player.meters, player.reader.waiting
    meters.span_s = seconds
    meters.frames.clear()
    busy, cpu = dict(meters.busy_s), time.process_time()
    dropped = waiting.dropped
    memory, began = _resident(), time.perf_counter()
    await asyncio.sleep(seconds)
    wall = time.perf_counter() - began
    found = meters.measure_rates_and_latency() | {
        "dropped": waiting.dropped - dropped,
        "share": {name: (meters.busy_s[name] - busy[name]) / wall for name in busy},
        "cores": (time.process_time() - cpu) / wall,
        "memory_mb": (memory, _resident()),
        "faults": player.faults.current(),
    }
    stop.set()
    await running_server
    player.stop()
    told = np.array((await visitor.stdout.read()).split(), float).reshape(-1, 2)
    await visitor.wait()
    return found | dict(zip(("messages", "bytes"), np.median(told, axis=0), strict=True))


def _resident() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fps", type=positive_number, default=600.0)
    parser.add_argument("--seconds", type=positive_number, default=60.0)
    parser.add_argument("--ckpt", default="setnet_small")
    parser.add_argument("--form", default=None)
    parser.add_argument("--threads", type=whole_number, default=1)
    asked = parser.parse_args()
    torch.set_num_threads(asked.threads)
    views, faults = kaleidoscope_views(list(layout(9)), model=MODEL, sensor=SENSOR), FaultLog()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "uniform.raw"
        write(path, views)
        networks = {asked.ckpt: files.load(asked.ckpt)}
        how = RunSettings(asked.fps, form=asked.form)
        feed = event_feeds.open_feed(str(path), None, faults, loop=True)
        server = assemble_server(feed, networks, views, how, faults, port=PORT)
        server.page.controls.choose(asked.ckpt, "all")
        sys.setswitchinterval(GIL_SWITCH_S)
        found = asyncio.run(measure(server, asked.seconds))
    report(asked, found)


def report(asked: argparse.Namespace, found: dict) -> None:
    """Print what was measured."""
    height, width = MODEL
    print(
        f"{asked.ckpt}, form={asked.form or 'null'}, nine views of {width}x{height},"
        f" {asked.threads} threads, {asked.seconds:.0f} s: {found['fps']:.1f} of {asked.fps:.0f}"
        " frames a second,"
        f" {found['dropped']} windows dropped"
    )
    latency = found["latency_ms"]
    print(f"latency: {latency['median']} ms median, {latency['p99']} ms at 99 %")
    print(f"events: {found['events_per_s'] / 1e6:.2f} million a second in windows that were shown")
    shares = ", ".join(f"{name} {share:.1%}" for name, share in found["share"].items())
    print(f"share of a core: {shares}; the whole process {found['cores']:.2f} cores")
    before, after = found["memory_mb"]
    print(
        f"the visitor got {found['messages']:.0f} messages, {found['bytes'] / 1e6:.2f} MB a second;"
        f" memory {before:.0f} MB at the start, {after:.0f} MB at the end {found['faults']}"
    )


if __name__ == "__main__":
    run_script(main)
