"""Pictures of a run: a GIF of what goes in and out, slices in time, and the nine views."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from src.figures.comparison import Row, comparison
from src.figures.video import enlarged, event_picture, row, write_video
from src.models.unroll import video
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, Sample, simulate

PLAYBACK_FPS = 15.0


@torch.no_grad()
def write(folder: Path, network: nn.Module, pipeline: Pipeline, clips: int = 2) -> list[Path]:
    """Write `clip<i>.gif` (clean, centre view, events, reconstruction) and `clip<i>_slice.png`
    (x-t slices of the middle row) of the first `clips` clips; return the paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network.eval()
    written = []
    for index in range(clips):
        sample = simulate(pipeline, [index])
        parts = {"clean": sample.target, "centre view": sample.turbulent}
        parts["reconstruction"] = video(network, sample).float().clamp(0, 1)
        videos = {name: part[0, :, 0].cpu().numpy() for name, part in parts.items()}
        written += [
            _gif(folder / f"clip{index}.gif", videos, sample, pipeline.optics),
            _slices(folder / f"clip{index}_slice.png", videos, float(sample.window_s[0])),
        ]
    return written


def write_views(
    folder: Path, sample: Sample, views: Tensor, tilt: Tensor, optics: Optics
) -> list[Path]:
    """Write `views.gif` and its last frame `views.png`: the clean clip, what every view sees, its
    tilt and its events, each in the views' arrangement.

    `views` (views, windows, h, w) light in [0, 1]; `tilt` (views, windows, 2, h, w) in pixels: blue
    where the picture is pushed right or down, red where left or up, mean of both axes.
    """
    clean = sample.target[0, :, 0].numpy()
    events = [event_picture(part.sum(1).numpy()) for part in sample.voxels[0].unbind(1)]
    reach = float(tilt.abs().max().clamp(min=1e-6))
    pushed = [event_picture(part.mean(1).numpy(), full=reach) for part in tilt]
    shown = mosaic([_rgb(view.numpy()) for view in views], optics)
    panels = {
        "clean": enlarged(_rgb(clean), shown.shape[1] // clean.shape[1]),
        "views": shown,
        f"tilt, +-{reach:.1f} px": mosaic(pushed, optics),
        "events": mosaic(events, optics),
    }
    frames = row(panels)
    paths = [folder / "views.gif", folder / "views.png"]
    write_video(paths[0], frames, PLAYBACK_FPS)
    write_video(paths[1], frames[-1:], PLAYBACK_FPS)
    return paths


def _gif(path: Path, videos: dict[str, np.ndarray], sample: Sample, optics: Optics) -> Path:
    counts = sample.voxels[0, :, optics.centre].sum(1).cpu().numpy()
    panels = {name: _rgb(videos[name]) for name in ("clean", "centre view")}
    panels |= {"events": event_picture(counts), "reconstruction": _rgb(videos["reconstruction"])}
    write_video(path, row(panels), PLAYBACK_FPS)
    return path


def _slices(path: Path, videos: dict[str, np.ndarray], window_s: float) -> Path:
    windows, height, width = videos["clean"].shape
    middle = height // 2
    line = np.array([[0, middle], [width - 1, middle]], dtype=float)
    rows = [Row(name, video, video[:, middle]) for name, video in videos.items()]
    picks = [0, windows // 3, 2 * windows // 3, windows - 1]
    comparison(rows, path, samples=picks, line=line, length_s=(windows - 1) * window_s)
    return path


def _rgb(video: np.ndarray) -> np.ndarray:
    return np.repeat(video[..., None], 3, axis=-1)


def mosaic(videos: list[np.ndarray], optics: Optics) -> np.ndarray:
    """Place (windows, h, w, 3) videos where their views stand; gaps are white."""
    rows, columns = zip(*optics.positions, strict=True)
    height, width = videos[0].shape[1:3]
    size = ((max(rows) - min(rows) + 1) * height, (max(columns) - min(columns) + 1) * width)
    canvas = np.ones((len(videos[0]), *size, 3), np.float32)
    for (r, c), film in zip(optics.positions, videos, strict=True):
        top, left = (r - min(rows)) * height, (c - min(columns)) * width
        canvas[:, top : top + height, left : left + width] = film
    return canvas
