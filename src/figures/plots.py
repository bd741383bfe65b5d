"""Pictures in a grid and curves with spread, in one readable style, written whole or not at all."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

Picture = Float[np.ndarray, "_h _w"] | Float[np.ndarray, "_h _w 3"]

PANEL_IN = 2.2  # width of a picture of a grid, in inches
DPI = 150
COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "black")
MARKERS = "osD^vP*"


def save(figure: Figure, path: Path) -> Path:
    """Write `figure` under a temporary name, then rename; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    figure.savefig(partial, dpi=DPI)
    os.replace(partial, path)
    return path


def grid(path: Path, rows: Mapping[str, Mapping[str, Picture]]) -> Path:
    """Draw rows of titled pictures, grey (h, w) or colour (h, w, 3) in [0, 1], pixels as squares.

    Rows may differ in length.  Raises ValueError without a picture.
    """
    pictures = [picture for row in rows.values() for picture in row.values()]
    if not pictures:
        raise ValueError("a grid must have at least 1 picture, got none")
    columns = max(map(len, rows.values()))
    tallest = max(picture.shape[0] / picture.shape[1] for picture in pictures)
    size = (PANEL_IN * columns, (PANEL_IN * tallest + 0.25) * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(rows), columns, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for row, (name, titled) in zip(panels, rows.items(), strict=True):
        for axes, (title, picture) in zip(row, titled.items(), strict=False):
            axes.imshow(picture, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
            axes.set_title(title, fontsize=8)
        row[0].text(
            -0.04, 0.5, name, transform=row[0].transAxes, rotation=90, ha="right", va="center"
        )
    return save(figure, path)


def curves(
    path: Path,
    lines: Mapping[str, Sequence[Float[np.ndarray, " points"]]],
    *,
    xlabel: str,
    ylabel: str,
    title: str = "",
    log: str = "",
) -> Path:
    """Draw each line (x, y) or (x, y, spread): the spread is shaded on both sides of the line.

    Labels carry the units; `log` names the logarithmic axes: "", "x", "y" or "xy".
    """
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for place, (name, (x, y, *spread)) in enumerate(lines.items()):
        colour, marker = COLOURS[place % len(COLOURS)], MARKERS[place % len(MARKERS)]
        axes.plot(x, y, marker=marker, color=colour, markersize=4, linewidth=1.5, label=name)
        if spread:
            axes.fill_between(x, y - spread[0], y + spread[0], color=colour, alpha=0.15, lw=0)
    axes.set(xlabel=xlabel, ylabel=ylabel, title=title)
    for name in log:
        axes.set(**{f"{name}scale": "log"})
    axes.grid(alpha=0.3)
    if len(lines) > 1:
        axes.legend(fontsize=8)
    return save(figure, path)
