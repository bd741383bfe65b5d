"""Recordings through networks, one view each, in one figure:

    python -m scripts.gallery RECORDING ... --out FILE.png [--networks NAME ...] [--published DIR]

A row for each recording, its last frame by each network: one of weights/ or, with the folder of
published weights, of scripts.readme's baselines.  Below it its invented contrast, which says
something where the camera stood still.  A recording that does not state the size of its sensor is
written FILE@HEIGHTxWIDTH.  Where images.txt, the list of a camera's frames, lies beside a
recording, the frame nearest in time stands last.
"""

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure

from scripts.readme import BASELINES, baseline_overrides
from src.app import methods
from src.app.compose import compose_config
from src.app.script import run_script
from src.figures import plots
from src.metrics.invented_contrast import find_unseen_pixels, invented_contrast
from src.reconstruct import choose_views, reconstruct_video_frames
from src.recordings.files import recording_inputs, videos
from src.recordings.files.frame_files import read_frame_list
from src.recordings.noise_filter import find_supported_pixels
from src.recordings.reconstruction import Frame, require_event_network

FPS = 120
WIDE = 2.4  # inches: width of a panel
CAMERA = "images.txt"


def last(recording: str, network: str, published: Path | None) -> Frame:
    """Return the last frame of `recording` by `network`, which is given its one view."""
    path, _, size = recording.partition("@")
    chosen = baseline_overrides(network, published) if network in BASELINES else [f"ckpt={network}"]
    sensor = [f"sensor_size=[{size.replace('x', ',')}]"] if size else []
    cfg = compose_config("reconstruct", f"recording={path}", f"fps={FPS}", *chosen, *sensor)
    loaded = require_event_network(methods.load_ckpt_or_baseline(cfg))
    frames, _ = reconstruct_video_frames(cfg, loaded, choose_views(cfg, loaded))
    *_, frame = frames
    return frame


def camera(recording: str, time_s: float) -> Float[np.ndarray, "h w"] | None:
    """Return the camera's frame nearest to `time_s`, if there is a camera; ValueError for a list of
    its frames that cannot be read."""
    listing = Path(recording.partition("@")[0]).parent / CAMERA
    if not listing.is_file():
        return None
    frames = read_frame_list(listing)
    nearest = min(frames, key=lambda row: abs(row[0] - time_s), default=None)
    return None if nearest is None else next(videos.read_video(nearest[1]))


def unseen(recording: str, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Return where no event that is not noise was ever near."""
    events = recording_inputs.iter_recording(recording.partition("@")[0], size, 0.05)
    return find_unseen_pixels(find_supported_pixels(events, size))


def gallery(recordings: list[str], networks: list[str], published: Path | None) -> Figure:
    """Draw a row of last frames for each recording, and print their invented contrast."""
    rows = [[last(recording, name, published) for name in networks] for recording in recordings]
    seen = [
        camera(recording, row[-1].time_s) for recording, row in zip(recordings, rows, strict=True)
    ]
    columns = len(networks) + any(picture is not None for picture in seen)
    shapes = [row[0].picture.shape for row in rows]
    heights = [WIDE * height / width for height, width in shapes]
    figure = Figure(figsize=(WIDE * columns, sum(heights) + 0.4), layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for recording, row, picture, axes in zip(recordings, rows, seen, grid, strict=True):
        pictures = [*(frame.picture for frame in row), picture]
        unseen_px, values = unseen(recording, row[0].picture.shape), []
        for panel, shown in zip(axes, pictures, strict=False):
            panel.set(xticks=[], yticks=[])
            if shown is not None and shown is not picture:
                value = invented_contrast(shown, unseen_px)
                values.append("" if np.isnan(value) else f"{value:.3f}")
                panel.set_xlabel(values[-1], fontsize=7)
            if shown is not None:
                panel.imshow(shown, cmap="gray", vmin=0, vmax=1)
            else:
                panel.set_axis_off()
        path = Path(recording.partition("@")[0])
        name = path.parent.name if path.stem == "events" else path.stem
        axes[0].set_ylabel(name, fontsize=7)
        print("| " + " | ".join([name, *values]) + " |")
    for panel, name in zip(grid[0], [*networks, "camera"], strict=False):
        panel.set_title(name, fontsize=9)
    return figure


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument(
        "--networks", nargs="+", default=["setnet_medium", "setnet_small", "single256"]
    )
    parser.add_argument("--published", type=Path, help="a folder of published weights")
    given = parser.parse_args()
    unknown = [name for name in given.networks if BASELINES.get(name) and not given.published]
    if unknown:
        parser.error(f"--networks {' '.join(unknown)} needs --published")
    print("| " + " | ".join(["invented contrast", *given.networks]) + " |")
    print("|---|" + "---|" * len(given.networks))
    plots.save_figure(gallery(given.recordings, given.networks, given.published), given.out)


if __name__ == "__main__":
    run_script(main)
