"""Time the sensor, the voxel grids and the event files: python -m benchmarks.sensor [--batch N]
[--device cuda].

Nine views of a clip of 1/f texture and hard discs that pans by one pixel a frame and shakes by one.
Milliseconds are per frame interval of all nine views, the smallest CPU time of the thread over the
repeats (wall time with two threads): the machine may be shared.  `--batch` only times N clips of
different sensors, at once and one by one, and counts torch's operators, each a launch on a GPU.
"""

import argparse
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional
from torch.profiler import ProfilerActivity, profile

from benchmarks.timing import least
from src.app.script import run_script, whole_number
from src.recordings.files.event_writers import write_events
from src.recordings.files.recording import iter_events
from src.sim.sensor import EventSensor
from src.sim.sensor.engine_input import SensorClip
from src.sim.sensor.sensor import simulate_voxels
from src.sim.voxel import voxel_grid

SIDE, FPS = 256, 120.0
RANDOM = {
    "threshold": [0.1, 0.7], "off_ratio": [0.8, 1.25], "refractory_s": [0.0005, 0.005],
    "mismatch": [0.0, 0.15], "dark_noise_hz": [0.0, 2.0], "initial_reference_error": [0.05, 1.0],
}  # fmt: skip


def clip(views: int, frames: int, seed: int = 0) -> torch.Tensor:
    """Return (1, views, frames, 256, 256) in 8-bit code values / 255."""
    g = torch.Generator().manual_seed(seed)
    wide = 2 * SIDE
    axis = torch.fft.fftfreq(wide)
    spectrum = torch.randn(wide, wide, dtype=torch.complex64, generator=g)
    texture = torch.fft.ifft2(spectrum / (axis[:, None] ** 2 + axis**2).sqrt().clamp(min=1 / wide))
    picture = torch.sigmoid(0.6 * texture.real / texture.real.std())
    y, x = torch.meshgrid(torch.arange(wide), torch.arange(wide), indexing="ij")
    discs = torch.rand(40, 4, generator=g) * torch.tensor([wide, wide, 30, 0.8]) + 0.1
    for cx, cy, r, value in discs:
        picture[(x - cx) ** 2 + (y - cy) ** 2 < r**2] = value
    out = torch.empty(1, views, frames, SIDE, SIDE)
    for v in range(views):
        shake = functional.avg_pool1d(torch.randn(2, frames + 4, generator=g), 5, 1) * 5**0.5
        for k in range(frames):
            dx, dy = 100 + k + float(shake[0, k]), 100 + float(shake[1, k])
            shift = torch.tensor([[1, 0, dx], [0, 1, dy]])
            place = torch.stack([x, y, torch.ones_like(x)], -1)[:SIDE, :SIDE].float() @ shift.T
            grid = (place / (wide - 1) * 2 - 1)[None]
            out[0, v, k] = functional.grid_sample(picture[None, None], grid, align_corners=True)[
                0, 0
            ]
    return (out * 255).round() / 255


def sensors(frames: torch.Tensor, repeats: int) -> None:
    """Print milliseconds per interval of nine views for several sensors."""
    noisy = {"mismatch": 0.25, "leak_event_hz": 0.1, "dark_noise_hz": 5.0, "cutoff_hz": 30.0}
    cases = {
        "C 0.1, 5 ms": {"threshold": 0.1},
        "C 0.2, 5 ms": {"threshold": 0.2},
        "C 0.5, 5 ms": {"threshold": 0.5},
        "C 0.1, 0": {"threshold": 0.1, "refractory_s": 0.0},
        "C 0.2, 5 ms, delete": {"threshold": 0.2, "refractory": "delete"},
        "C 0.2, 5 ms, hold": {"threshold": 0.2, "refractory": "hold"},
        "C 0.2, 5 ms, v2e stamps": {"threshold": 0.2, "stamps": "v2e"},
        "C 0.2, 5 ms, noisy": {"threshold": 0.2, **noisy},
    }
    intervals = frames.shape[2] - 1
    print(f"{'sensor':26} {'ev/px/s':>8} {'1 thread':>9} {'2 threads':>9}  ms/interval")
    for name, settings in cases.items():
        sensor = EventSensor(**settings)
        rate = float(sensor.counts(frames, FPS).sum()) / frames[0, :, 0].numel() / intervals * FPS
        torch.set_num_threads(2)
        two = least(lambda s=sensor: s.voxels(frames, FPS), time.perf_counter, repeats)
        torch.set_num_threads(1)
        one = least(lambda s=sensor: s.voxels(frames, FPS), repeats=repeats)
        times = " ".join(f"{1e3 * t / intervals:9.2f}" for t in (one, two))
        print(f"{name:26} {rate:8.1f} {times}")


def batches(count: int, repeats: int, device: str, side: int = 96, frames: int = 41) -> None:
    """Print milliseconds and operators of `count` clips of float16, each with a sensor of its own,
    in one call and in a call for each.
    """
    wide, g = clip(9, frames)[0], torch.Generator().manual_seed(0)
    corners = torch.randint(0, SIDE - side, (count, 2), generator=g).tolist()
    views = torch.stack([wide[..., y : y + side, x : x + side] for y, x in corners])
    views, sensor = views.half().to(device), EventSensor(random=RANDOM, response="linlog")
    drawn = [sensor.draw(key, pixel_seed=key) for key in range(count)]
    numbered = enumerate(zip(drawn, corners, strict=True))
    given = [SensorClip(one, FPS, key, place, SIDE) for key, (one, place) in numbered]

    def work(each: int) -> None:
        for i in range(0, count, each):
            simulate_voxels(given[i : i + each], views[i : i + each], range(9))
        if device != "cpu":
            torch.cuda.synchronize()

    clock = time.thread_time if device == "cpu" else time.perf_counter
    for name, each in (("in one call", count), ("one by one", 1)):
        seconds = least(lambda each=each: work(each), clock, repeats)
        with profile(activities=[ProfilerActivity.CPU]) as seen:
            work(each)
        operators = sum(event.name.startswith("aten::") for event in seen.events())
        print(
            f"{count} clips of 9 x {frames} x {side} x {side} {name}: {1e3 * seconds:.1f} ms, "
            f"{operators} operators"
        )


def voxelising(repeats: int) -> None:
    """Print million events per second of list -> voxel grid and of EVT3 file -> voxel windows."""
    g = np.random.default_rng(0)
    n = 1_000_000
    t = np.sort(g.integers(0, 100_000, n))
    x, y = g.integers(0, 1280, n).astype(np.uint16), g.integers(0, 720, n).astype(np.uint16)
    p = g.choice(np.array([-1, 1], np.int8), n)
    size = {"bins": 5, "height": 720, "width": 1280}
    seconds = least(lambda: voxel_grid(t, x, y, p, t0=0, t1=100_000, **size), repeats=repeats)
    print(f"list to voxel grid, 1280x720, scattered: {n / seconds / 1e6:.0f} Mev/s")
    near_x, near_y = (x % 256).astype(np.uint16), (y % 256).astype(np.uint16)
    small = {"bins": 5, "height": 256, "width": 256}
    seconds = least(
        lambda: voxel_grid(t, near_x, near_y, p, t0=0, t1=100_000, **small), repeats=repeats
    )
    print(f"list to voxel grid, 256x256, scattered: {n / seconds / 1e6:.0f} Mev/s")
    files(repeats)


def files(repeats: int) -> None:
    """Print how fast the events of a panning view come out of an EVT3 file as windows."""
    frames = clip(1, 31)[0, 0]
    one = EventSensor(0.1, refractory_s=0.0).events(frames, FPS)
    length = int(one["t"][-1]) + 1
    events = np.concatenate([one] * 8)
    events["t"] += np.repeat(np.arange(8), len(one)) * length
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.raw"
        write_events(path, events, width=SIDE, height=SIDE)

        def read() -> None:
            for part in iter_events(path, seconds=1 / FPS):
                ends = {"t0": int(part["t"][0]), "t1": int(part["t"][0]) + 8334}
                columns = (part[name] for name in "txyp")
                voxel_grid(*columns, **ends, bins=5, height=SIDE, width=SIDE)

        whole = least(read, repeats=max(3, repeats // 4))
        only = least(lambda: sum(map(len, iter_events(path))), repeats=max(3, repeats // 4))
    n = len(events)
    print(f"EVT3 file of {n} events: read {n / only / 1e6:.0f} Mev/s, to voxel windows", end=" ")
    print(f"{n / whole / 1e6:.0f} Mev/s")


def main() -> None:
    """Print everything."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=whole_number, default=20)
    parser.add_argument("--frames", type=whole_number, default=11)
    parser.add_argument(
        "--batch", type=whole_number, help="time so many clips of different sensors only"
    )
    parser.add_argument("--device", default="cpu", help="where --batch runs")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.batch:
        batches(arguments.batch, arguments.repeats, arguments.device)
        return
    voxelising(arguments.repeats)
    sensors(clip(9, arguments.frames), arguments.repeats)


if __name__ == "__main__":
    run_script(main)
