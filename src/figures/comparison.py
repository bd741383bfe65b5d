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
    rows: Sequence[VideoRow], path: Path, *, line: Float[np.ndarray, "k 2"], length_s: float,
    samples: int = 4, axis: str = "x",
) -> None:  # fmt: skip
    """Draw one row per video: so many `samples` of its frames, the `line` (x, y) of the slice in
    yellow on the first, and the slice with time downwards over `length_s` seconds.

    `axis` names the coordinate along the line: x, y, r or theta.
    """
    shortest = min(len(row.video) for row in rows)
    picks = np.linspace(0, shortest - 1, samples).astype(int)
    columns = samples + 1 + any(row.note for row in rows)  # samples, slice, note
    height, width = rows[0].video.shape[1:]
    panel_height = max(PANEL_WIDTH_IN * height / width, MIN_PANEL_HEIGHT_IN)
    size = (PANEL_WIDTH_IN * columns + 0.5, (panel_height + 0.2) * len(rows) + 0.4)
    figure = Figure(figsize=size)
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for row, axes in zip(rows, grid, strict=True):
        for sample, panel in zip(picks, axes, strict=False):
            panel.imshow(row.video[sample], vmin=0, vmax=1)
            panel.set(xticks=[], yticks=[])
        axes[0].plot(*line.T, color=LINE_COLOUR, linewidth=1)
        axes[0].set_ylabel(row.name, fontsize=min(9, 100 * panel_height / max(len(row.name), 1)))
        extent = (0, row.slice.shape[1], 1e3 * length_s, 0)
        axes[samples].imshow(row.slice, aspect="auto", extent=extent, vmin=0, vmax=1)
        axes[samples].tick_params(labelsize=6)
        for beside in axes[samples + 1 :]:
            beside.set_axis_off()
            beside.text(0, 1, row.note, fontsize=8, va="top", transform=beside.transAxes)
    for sample, panel in zip(picks, grid[0], strict=False):
        time_ms = 1e3 * length_s * sample / max(shortest - 1, 1)
        panel.set_title(f"{time_ms:.1f} ms", fontsize=8)
    grid[0, samples].set_title(f"{axis}-t, {1e3 * length_s:.0f} ms", fontsize=8)
    save_figure(figure, path)
