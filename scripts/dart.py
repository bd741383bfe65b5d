"""How straight a dart flies at 12,000 fps: python -m scripts.dart OUT [--darts 4] [--windows 100].

Darts of the paper's 16,000 px/s cross a 128x128 field through strong turbulence (a new atmosphere
each) and are recorded by a simulated EVK4 behind a kaleidoscope, dart-0/cap.raw ... below OUT; the
shipped networks reconstruct every recording window by window.  A dart's place in a picture is that
of its front: the centroid of what has become brighter in the last frames, near the true place, so
that a trail which stays does not count.  Printed is the rms distance from the known line, across
it, an offset removed, in pixels, with the interval over darts.  `still air` is the same without
turbulence: what the measure and the network themselves make of a straight line.  OUT/darts.csv
holds every dart.
"""

import argparse
import csv
from pathlib import Path

import h5py
import numpy as np
import torch
from hydra import compose, initialize_config_dir

from src.app import build
from src.metrics.bootstrap import difference, interval
from src.metrics.temporal import straightness
from src.reconstruct import reconstruct
from src.recordings import capture
from src.recordings.files import sources
from src.sim.pipeline import Draw

CONF = Path(__file__).resolve().parents[1] / "conf"
FPS, SIDE, SPEED, LENGTH = 12_000.0, 128, 16_000.0, 0.25
LAG = 6  # frames, 8 px of flight, over which brightening is looked at
GATE = 24.0  # pixels around the true place that are looked at: the dart is 32 long
MARGIN = 12.0  # pixels from the frame's border within which the middle of the dart is not scored
METHODS = {  # name: network, views file, what a window spans
    "lf3x3, nine views": ("lf3x3", "cap.views.yaml", "frame"),
    "single256, one view": ("single256", "cap.views.yaml", "frame"),
    "lf3x3, windows of 1/120 s": ("lf3x3", "cap.views.yaml", "trained"),
    "single256, windows of 1/120 s": ("single256", "cap.views.yaml", "trained"),
    "setnet_small, nine views": ("setnet_small", "cap.views.yaml", "frame"),
    "setnet_small, one view": ("setnet_small", "centre.yaml", "frame"),
    "setnet_medium, nine views": ("setnet_medium", "cap.views.yaml", "frame"),
    "setnet_medium, one view": ("setnet_medium", "centre.yaml", "frame"),
}
FRAMES = ("frames, mean of nine views", "frames, one view")  # no camera, no network: the air alone
PAIRS = list(zip((*FRAMES, *METHODS)[::2], (*FRAMES, *METHODS)[1::2], strict=True))


def config(door: str, *overrides: str):
    """Return the config of a door."""
    with initialize_config_dir(str(CONF), version_base=None):
        return compose(door, list(overrides))


def record(folder: Path, index: int, turbulence: str, windows: int) -> tuple[Draw, torch.Tensor]:
    """Record dart `index` as `folder`/cap.raw.  Returns its draw and views (views, frames, h, w).

    The pixels are those of the default 256-pixel frame, so that tilts are too.
    """
    air = [] if turbulence == "none" else [f"turbulence.atmosphere.width_px={SIDE}"]
    cfg = config(
        "simulate", "scene=targets", "scene.kinds=[dart]", f"scene.height={SIDE}",
        f"scene.width={SIDE}", f"scene.options.dart.speed={SPEED}", f"fps={FPS}", "sensor=evk4",
        f"scene.options.dart.length={LENGTH}", f"turbulence={turbulence}", *air,
        f"data.test_windows={windows}",
    )  # fmt: skip
    pipeline = build.pipeline(cfg, "test")
    draw = pipeline.draw(index)
    views = pipeline.views(draw)[0]
    camera = capture.kaleidoscope(list(pipeline.optics.positions), model=(SIDE, SIDE), key=draw.key)
    folder.mkdir(parents=True, exist_ok=True)
    capture.write_recording(folder / "cap.raw", views, FPS, camera, draw.sensor)
    camera.only([(0, 0)]).save(folder / "centre.yaml")
    return draw, views


def film(folder: Path, method: str) -> np.ndarray:
    """Reconstruct `folder`/cap.raw; returns the film (frames, h, w)."""
    name, views, span = METHODS[method]
    run = folder / method.replace(", ", "_").replace(" ", "-").replace("/", "-")
    cfg = config(
        "reconstruct", f"recording='{folder}/cap.raw'", f"views='{folder}/{views}'", f"ckpt={name}",
        f"fps={FPS}", f"span={span}", "output=hdf5",
    )  # fmt: skip
    cfg.paths.run = str(run)
    reconstruct(cfg)
    return np.stack(list(sources.film(run / "video.h5")))


def across(pictures: np.ndarray, truth: np.ndarray) -> float:
    """Return how far (px, rms) the front of the dart strays from its line.

    `truth` (frames, 2) is its middle (x, y) in each of `pictures` (frames, h, w).
    """
    y, x = np.mgrid[: pictures.shape[1], : pictures.shape[2]]
    risen = np.clip(pictures[LAG:] - pictures[:-LAG], 0, None)
    truth = truth[LAG:]
    inside = (np.abs(truth - (SIDE - 1) / 2) < SIDE / 2 - MARGIN).all(1)
    inside[: int(LENGTH * SIDE / SPEED * FPS)] = False  # until it has left where it began
    path = []
    for picture, (x0, y0) in zip(risen[inside], truth[inside], strict=True):
        near = np.hypot(x - x0, y - y0) < GATE
        weight = np.where(near, picture - picture[near].max() / 3, 0).clip(min=0)
        path.append([(weight * x).sum(), (weight * y).sum()] / weight.sum())
    along = truth[-1] - truth[0]
    normal = np.array([-along[1], along[0]]) / np.hypot(*along)
    found, known = (torch.from_numpy(p @ normal)[:, None] for p in (np.array(path), truth[inside]))
    return straightness(found, known)


def fly(out: Path, index: int, turbulence: str, windows: int) -> dict[str, float]:
    """Record dart `index` and return how far it strays in every film of it."""
    folder = out / f"dart-{index}-{turbulence}"
    draw, views = record(folder, index, turbulence, windows)
    truth = draw.clip.truth.numpy()
    late = first_event(folder)
    found = {
        name: across(pictures.numpy(), truth)
        for name, pictures in zip(FRAMES, (views.mean(0), views[4]), strict=True)
    }
    for method in METHODS:
        pictures = film(folder, method)
        # Frame k shows the end of window k, whose clock starts at the first event.
        time = late + np.arange(1, len(pictures) + 1) / FPS
        speed = (truth[1] - truth[0]) * FPS
        found[method] = across(pictures, truth[0] + time[:, None] * speed)
        print(f"dart {index}, {turbulence}: {method}: {found[method]:.2f} px", flush=True)
    if draw.air:
        size = draw.air
        print(f"D/r0 {size.d_over_r0:.1f}, tilt {size.tilt_std_px(SIDE):.2f} px", flush=True)
    return found


def first_event(folder: Path) -> float:
    """Return when the recording's clock starts, in seconds of the simulation."""
    with h5py.File(folder / "cap.truth.h5") as file:
        return float(file.attrs["first_event_us"]) * 1e-6


def main() -> None:
    """Read the arguments, fly the darts, print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--darts", type=int, default=4)
    parser.add_argument("--windows", type=int, default=100)
    given = parser.parse_args()
    strong = [fly(given.out, k, "strong", given.windows) for k in range(given.darts)]
    calm = fly(given.out, 0, "none", given.windows)
    with (given.out / "darts.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, ["air", *calm])
        table.writeheader()
        table.writerows([{"air": "strong", **row} for row in strong] + [{"air": "none", **calm}])
    print("| | still air | strong turbulence | 95 % |\n|---|---|---|---|")
    for name in calm:
        values = [row[name] for row in strong]
        low, high = interval(values)
        print(f"| {name} | {calm[name]:.2f} | {np.mean(values):.2f} | {low:.2f} to {high:.2f} |")
    print("| nine views less one | difference | 95 % |\n|---|---|---|")
    for nine, one in PAIRS:
        ours, theirs = ([[row[name] for row in strong]] for name in (nine, one))
        low, high = difference(ours, theirs)
        print(f"| {nine} | {np.mean(ours) - np.mean(theirs):+.2f} | {low:+.2f} to {high:+.2f} |")


if __name__ == "__main__":
    main()
