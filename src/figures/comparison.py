"""Videos under each other: sample frames of each and its space-time slice (figures 6, 9 and 11)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from src.figures.plots import save_figure

LINE_COLOUR = "gold"
PANEL_WIDTH_IN = 2.2
MIN_PANEL_HEIGHT_IN = 1.3  # for the lines of the note


@dataclass(frozen=True)
class VideoRow:
    """One method: its video, the space-time slice of it, and the text printed beside the slice."""

    name: str
    video: Float[np.ndarray, "frames h w"]
    slice: Float[np.ndarray, "frames places"]
    note: str = ""


def draw_comparison(
    rows: Sequence[VideoRow], path: Path, *, line: Float[np.ndarray, "k 2"], frame_s: float,
    start_s: float = 0.0, samples: int = 4, axis: str = "x",
) -> None:  # fmt: skip
    """Draw one row per video: so many `samples` of its frames, the `line` (x, y) of the slice in
    yellow on the first, and the slice with time downwards, `frame_s` seconds a frame, the first at
    `start_s`.

    `axis` names the coordinate along the line: x, y, r, in pixels, or theta, in degrees.
    """
    shortest = min(len(row.video) for row in rows)
    picks = np.linspace(0, shortest - 1, samples).astype(int)
    columns = samples + 1 + any(row.note for row in rows)  # samples, slice, note
    height, width = rows[0].video.shape[1:]
    panel_height = max(PANEL_WIDTH_IN * height / width, MIN_PANEL_HEIGHT_IN)
    size = (PANEL_WIDTH_IN * columns + 0.5, (panel_height + 0.2) * len(rows) + 0.4)
    figure = Figure(figsize=size)
    first, last = find_slice_ends(axis, line, rows[0].slice.shape[1])
    unit = "degrees" if axis == "theta" else "px"
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for row, axes in zip(rows, grid, strict=True):
        for sample, panel in zip(picks, axes, strict=False):
            panel.imshow(row.video[sample], vmin=0, vmax=1)
            panel.set(xticks=[], yticks=[])
        axes[0].plot(*line.T, color=LINE_COLOUR, linewidth=1)
        axes[0].set_ylabel(row.name, fontsize=min(9, 100 * panel_height / max(len(row.name), 1)))
        ends_ms = 1e3 * start_s, 1e3 * (start_s + frame_s * len(row.slice))
        extent = (first, last, ends_ms[1], ends_ms[0])
        axes[samples].imshow(row.slice, aspect="auto", extent=extent, vmin=0, vmax=1)
        axes[samples].tick_params(labelsize=6)
        axes[samples].set_xlabel(f"{axis}, {unit}", fontsize=6, labelpad=1)
        axes[samples].set_ylabel("t, ms", fontsize=6, labelpad=1)
        for beside in axes[samples + 1 :]:
            beside.set_axis_off()
            beside.text(0, 1, row.note, fontsize=8, va="top", transform=beside.transAxes)
    for sample, panel in zip(picks, grid[0], strict=False):
        panel.set_title(f"{1e3 * (start_s + frame_s * sample):.1f} ms", fontsize=8)
    grid[0, samples].set_title(f"{axis}-t, {1e3 * frame_s * shortest:.0f} ms", fontsize=8)
    save_figure(figure, path)


def find_slice_ends(axis: str, line: Float[np.ndarray, "k 2"], places: int) -> tuple[float, float]:
    """Return where a slice of so many `places` along `line` begins and ends, half a place before
    the first and after the last: x, y, or r from the first, in pixels, or theta in degrees."""
    if axis == "theta":
        first, step = 0.0, 360 / places
    else:
        column = {"x": 0, "y": 1}.get(axis)
        way = np.linalg.norm(line - line[0], axis=1) if column is None else line[:, column]
        first, step = float(way[0]), float(way[-1] - way[0]) / max(places - 1, 1) or 1.0
    return first - step / 2, first + (places - 0.5) * step
