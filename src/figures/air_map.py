"""Where views pay: maps over how far air moves a picture and how local it is."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from src.figures.plots import save

Cells = Mapping[tuple[float, float], tuple[float, str]]  # (half length, spread), px: value, text
PALE = 1.8  # times the largest value are the ends of the colours: text is read on all cells


def draw(path: Path, maps: Mapping[str, Cells]) -> Path:
    """Draw a panel for each of `maps`, purple below zero and orange above, each cell with its text.

    A cell that is not there is left grey.
    """
    places = {place for cells in maps.values() for place in cells}
    halves, spreads = (sorted({place[axis] for place in places}) for axis in (0, 1))
    figure = Figure(figsize=(0.6 + 0.9 * len(halves) * len(maps), 1.5 + 0.6 * len(spreads)),
                    layout="constrained")  # fmt: skip
    for axes, (title, cells) in zip(
        figure.subplots(1, len(maps), squeeze=False)[0], maps.items(), strict=True
    ):
        grid = [[(half, spread) for half in halves] for spread in spreads]
        values = np.array([[cells.get(place, (np.nan, ""))[0] for place in row] for row in grid])
        most = PALE * max(float(np.nanmax(np.abs(values))), 1e-9)
        axes.set_facecolor("#dddddd")
        axes.imshow(values, "PuOr_r", vmin=-most, vmax=most, origin="lower", aspect="auto")
        for (half, spread), (_, text) in cells.items():
            at = halves.index(half), spreads.index(spread)
            axes.text(*at, text, ha="center", va="center", fontsize=8)
        axes.set_xticks(range(len(halves)), [f"{half:g}" for half in halves])
        axes.set_yticks(range(len(spreads)), [f"{spread:g}" for spread in spreads])
        axes.set_title(title, fontsize=9)
    figure.supxlabel("half length of the tilt, px", fontsize=9)
    figure.supylabel("tilt and blur, px", fontsize=9)
    return save(figure, path)
