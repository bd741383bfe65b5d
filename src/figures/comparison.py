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
    columns = len(samples) + 1
    height, width = rows[0].video.shape[1:]
    size = (2 * columns + 0.8, 2 * len(rows) * height / width + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12)  # room for half the last number of the last axis
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for row, axes in zip(rows, grid, strict=True):
        for sample, panel in zip(samples, axes, strict=False):
            panel.imshow(row.video[sample], cmap="gray", vmin=0, vmax=1)
            panel.set(xticks=[], yticks=[])
        axes[0].plot(*line.T, color=LINE, linewidth=1)
        axes[0].set_ylabel(row.name, fontsize=min(9, 170 / max(len(row.name), 1)))
        _slice(axes[-1], row, length_s)
    for sample, panel in zip(samples, grid[0], strict=False):
        time = length_s * sample / max(shortest - 1, 1)
        panel.set_title(f"{1e3 * time:.1f} ms", fontsize=8)
    grid[0, -1].set_title(f"{axis}-t, {1e3 * length_s:.0f} ms", fontsize=8)
    plots.save(figure, Path(path))


def _slice(panel: Axes, row: Row, length_s: float) -> None:
    extent = (0, row.slice.shape[1], 1e3 * length_s, 0)
    panel.imshow(row.slice, cmap="gray", vmin=0, vmax=1, aspect="auto", extent=extent)
    panel.set_xlabel(row.note, fontsize=7)
    panel.tick_params(labelsize=6)
