"""Methods under each other: samples of each video and its slice in time (figures 6 to 10)."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from src.figures import plots

LINE = "gold"
PANEL = 2.2  # inches: width of a panel
LEAST = 1.3  # inches: height of a panel, for the lines of its note


@dataclass(frozen=True)
class Row:
    """One method: its video, the slice of it (frames, places), and what to print beside the slice,
    such as straightness and wander in pixels."""

    name: str
    video: Float[np.ndarray, "frames h w"]
    slice: Float[np.ndarray, "frames places"]
    note: str = ""


def comparison(
    rows: Sequence[Row],
    path: Path | str,
    *,
    samples: Sequence[int],
    line: Float[np.ndarray, "k 2"],
    length_s: float,
    axis: str = "x",
) -> None:
    """Draw one row per method: the frames `samples`, the `line` (x, y) of the slice in yellow on
    the first, and the slice with time downwards over `length_s` seconds.

    `axis` names the coordinate along the line: x, y, r or theta.  Raises ValueError for a sample
    that a video does not have.
    """
    shortest = min(len(row.video) for row in rows)
    if not all(0 <= sample < shortest for sample in samples):
        raise ValueError(f"samples must be in 0..{shortest - 1}, got {list(samples)}")
    columns = len(samples) + 2  # samples, slice, note
    height, width = rows[0].video.shape[1:]
    tall = max(PANEL * height / width, LEAST)  # inches
    size = (PANEL * columns + 0.5, (tall + 0.2) * len(rows) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for row, axes in zip(rows, grid, strict=True):
        for sample, panel in zip(samples, axes, strict=False):
            panel.imshow(row.video[sample], cmap="gray", vmin=0, vmax=1)
            panel.set(xticks=[], yticks=[])
        axes[0].plot(*line.T, color=LINE, linewidth=1)
        axes[0].set_ylabel(row.name, fontsize=min(9, 100 * tall / max(len(row.name), 1)))
        _slice(axes[-2], row, length_s)
        axes[-1].set_axis_off()
        axes[-1].text(0, 1, row.note, fontsize=8, va="top", transform=axes[-1].transAxes)
    for sample, panel in zip(samples, grid[0], strict=False):
        time = length_s * sample / max(shortest - 1, 1)
        panel.set_title(f"{1e3 * time:.1f} ms", fontsize=8)
    grid[0, -2].set_title(f"{axis}-t, {1e3 * length_s:.0f} ms", fontsize=8)
    plots.save(figure, Path(path))


def _slice(panel: Axes, row: Row, length_s: float) -> None:
    extent = (0, row.slice.shape[1], 1e3 * length_s, 0)
    panel.imshow(row.slice, cmap="gray", vmin=0, vmax=1, aspect="auto", extent=extent)
    panel.tick_params(labelsize=6)
