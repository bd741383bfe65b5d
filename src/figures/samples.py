"""Pictures of a run: a GIF of input and output, space-time slices, and the views."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.figures.comparison import VideoRow, draw_comparison
from src.figures.video import Video, join_panels, render_events, write_video
from src.models.network import VideoMethod
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, Sample, simulate

PLAYBACK_FPS = 15.0


@torch.no_grad()
def write_samples(
    folder: Path, network: VideoMethod, pipeline: Pipeline, clips: int = 2
) -> list[Path]:
    """Write `clip<i>.gif` (clean, centre view, events, reconstruction) and `clip<i>_slice.png`
    (x-t slices of the middle row) of the first `clips` clips; return the paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    network.eval()
    paths = []
    for index in range(clips):
        sample = simulate(pipeline, [index])
        parts = {"clean": sample.target, "centre view": sample.turbulent}
        parts["reconstruction"] = network.reconstruct_clip(sample).float().clamp(0, 1)
        videos = {name: part[0, :, 0].cpu().numpy() for name, part in parts.items()}
        gif, slices = folder / f"clip{index}.gif", folder / f"clip{index}_slice.png"
        counts = sample.voxels[0, :, pipeline.optics.centre].sum(1).cpu().numpy()
        events = {"events": render_events(counts), "reconstruction": videos["reconstruction"]}
        first = {name: videos[name] for name in ("clean", "centre view")}
        write_video(gif, join_panels(first | events), PLAYBACK_FPS)
        windows, height, width = videos["clean"].shape
        line = np.array([[0, height // 2], [width - 1, height // 2]], dtype=float)
        rows = [VideoRow(name, video, video[:, height // 2]) for name, video in videos.items()]
        draw_comparison(rows, slices, line=line, length_s=(windows - 1) * float(sample.window_s[0]))
        paths += [gif, slices]
    return paths


def write_light_field(
    folder: Path, sample: Sample, views: Float[Tensor, "views windows h w"],
    tilt: Float[Tensor, "views windows 2 h w"], optics: Optics,
) -> list[Path]:  # fmt: skip
    """Write `views.gif` and its last frame `views.png`: the clean clip, and of every view its
    light, in [0, 1], its tilt and its events, in the arrangement of the views.

    `tilt`, in pixels, is drawn as the mean of both axes: blue where the picture is pushed right or
    down, red where left or up.
    """
    events = [render_events(part.sum(1).numpy()) for part in sample.voxels[0].unbind(1)]
    reach = float(tilt.abs().max().clamp(min=1e-6))
    pushed = [render_events(part.mean(1).numpy(), full=reach) for part in tilt]
    panels = {
        "clean": sample.target[0, :, 0].numpy(),
        "views": tile_views([view.numpy() for view in views], optics),
        f"tilt, +-{reach:.1f} px": tile_views(pushed, optics),
        "events": tile_views(events, optics),
    }
    frames = join_panels(panels)
    paths = [folder / "views.gif", folder / "views.png"]
    write_video(paths[0], frames, PLAYBACK_FPS)
    write_video(paths[1], frames[-1:], PLAYBACK_FPS)
    return paths


def tile_views(videos: list[Video], optics: Optics) -> Video:
    """Place the videos of the views where their apertures are; gaps are white."""
    rows, columns = zip(*optics.positions, strict=True)
    frames, height, width, *rgb = videos[0].shape
    size = ((max(rows) - min(rows) + 1) * height, (max(columns) - min(columns) + 1) * width)
    canvas = np.ones((frames, *size, *rgb), np.float32)
    for row, column, video in zip(rows, columns, videos, strict=True):
        top, left = (row - min(rows)) * height, (column - min(columns)) * width
        canvas[:, top : top + height, left : left + width] = video
    return canvas
