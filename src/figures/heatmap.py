"""The stress map: probes down, networks across; colour: how far from the limit, text: how much."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from src.bench.probes.standard import Finding
from src.figures.plots import save

# Blue holds and orange breaks: told apart by the colour-blind and in grey.
COLOURS = LinearSegmentedColormap.from_list("limits", ["#2f6fab", "#dbe7f3", "#f8ddc4", "#c8501e"])
ROW_IN, COLUMN_IN, TITLE_IN = 0.34, 0.98, 4.6
NOTHING = "#efefef"


def stress_map(
    path: Path,
    findings: Mapping[str, Mapping[str, Finding | str]],
    titles: Mapping[str, str],
    standards: Mapping[str, float],
) -> Path:
    """Draw every cell; an empty one is hatched.  Colours are blue within the limit, orange beyond,
    deepest at ten times, with the limit itself written beside the probe's title.  `standards`: the
    aligned PSNR in dB of each network where nothing is made hard, written under its name.
    """
    networks = list(next(iter(findings.values())))
    size = (TITLE_IN + COLUMN_IN * len(networks), 1.6 + ROW_IN * len(findings))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots()
    for row, cells in enumerate(findings.values()):
        for column, cell in enumerate(cells.values()):
            _draw(axes, row, column, cell)
    axes.set_xlim(0, len(networks))
    axes.set_ylim(len(findings), 0)
    wrapped = [_heading(name, standards.get(name)) for name in networks]
    axes.set_xticks(np.arange(len(networks)) + 0.5, wrapped, fontsize=9)
    axes.xaxis.tick_top()
    labels = [f"{titles[probe]}   {_limit(cells)}" for probe, cells in findings.items()]
    axes.set_yticks(np.arange(len(findings)) + 0.5, labels, fontsize=9)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    figure.supxlabel(
        "under the name: aligned PSNR on the standard clips\nblue: within the limit; orange: "
        "beyond it, deep at 10 times\nhatched: did not run, the text says why",
        fontsize=8,
    )
    return save(figure, path)


def badness(cell: Finding) -> float:
    """Return 0..1, 0.5 at the limit: the logarithm of the ratio to the limit, cut at 10 times.

    Where the limit is 0, of the value in units of 0.01.
    """
    value, limit = cell.value, cell.limit
    if not math.isfinite(value):
        return 1.0
    if limit == 0:
        decades = (value if not cell.high else -value) / 0.01
        return 0.2 if value == 0 else _squash(decades)
    if cell.high:
        # What is missing to 100 %, against what may be missing.
        value, limit = 100 - value, 100 - limit
    ratio = max(value, 1e-9) / limit
    return _squash(math.log10(ratio))


def _heading(name: str, standard: float | None) -> str:
    wrapped = name.replace("_", "\n", 1).replace("_", " ")
    return wrapped if standard is None else f"{wrapped}\n{standard:.1f} dB"


def _squash(decades: float) -> float:
    return 0.5 + 0.5 * max(-1.0, min(1.0, decades))


def _draw(axes, row: int, column: int, cell: Finding | str) -> None:
    if isinstance(cell, str):
        box = {"facecolor": NOTHING, "edgecolor": "white", "hatch": "////", "linewidth": 2}
        axes.add_patch(Rectangle((column, row), 1, 1, **box))
        return
    shade = badness(cell)
    face = {"facecolor": COLOURS(shade), "edgecolor": "white", "linewidth": 2}
    axes.add_patch(Rectangle((column, row), 1, 1, **face))
    dark = shade > 0.85 or shade < 0.15
    style = {"color": "white" if dark else "black", "weight": "bold" if cell.failed else "normal"}
    axes.text(column + 0.5, row + 0.5, written(cell), ha="center", va="center", fontsize=9, **style)


def written(cell: Finding) -> str:
    """Return the value as it stands in its cell."""
    value = cell.value
    if not math.isfinite(value):
        return "∞" if value > 0 else "–"
    if value == 0:
        return "0"
    if abs(value) < 0.0095:
        return f"{value:.0e}".replace("e-0", "e-")
    digits = 0 if abs(value) >= 20 else 1 if abs(value) >= 1 else 2
    return f"{value:.{digits}f}"


def _limit(cells: Mapping[str, Finding | str]) -> str:
    ran = [cell for cell in cells.values() if isinstance(cell, Finding)]
    if not ran:
        return ""
    sign = "≥" if ran[0].high else "≤"
    return f"{sign} {ran[0].limit:g} {ran[0].unit}"
