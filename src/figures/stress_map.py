"""The stress map: tests down, networks across; colour: how far from the limit, text: the value."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from src.bench.stress_tests.stress_results import StressResult, format_value
from src.figures.plots import save_figure

# Blue passes and orange fails: told apart by the colour-blind and in grey.
COLOURS = LinearSegmentedColormap.from_list("limits", ["#2f6fab", "#dbe7f3", "#f8ddc4", "#c8501e"])
ROW_IN, COLUMN_IN, TITLE_IN = 0.34, 0.98, 4.6
NOT_RUN: dict[str, Any] = {"facecolor": "#efefef", "hatch": "////"}
LEGEND = """under the name: aligned PSNR on the standard clips
blue: within the limit; orange: beyond it, deep at 10 times
hatched: did not run, stress.md says why; ∞: not within the clip; –: no number"""


def draw_stress_map(
    path: Path, outcomes: Mapping[str, Mapping[str, StressResult | str]],
    titles: Mapping[str, str], standard_psnr: Mapping[str, float],
) -> Path:  # fmt: skip
    """Draw every outcome; what did not run is hatched.

    `standard_psnr`: of each network on the standard clips in dB, written under its name.
    """
    networks = list(next(iter(outcomes.values())))
    size = (TITLE_IN + COLUMN_IN * len(networks), 1.6 + ROW_IN * len(outcomes))
    figure = Figure(figsize=size)
    axes = figure.subplots()
    labels = []
    for row, (test, cells) in enumerate(outcomes.items()):
        for column, outcome in enumerate(cells.values()):
            _draw_cell(axes, row, column, outcome)
        ran = [outcome for outcome in cells.values() if isinstance(outcome, StressResult)]
        sides = [f"{'≥' if r.higher_is_better else '≤'} {r.limit:g} {r.unit}" for r in ran[:1]]
        labels.append("   ".join([titles[test], *sides]))
    axes.set(xlim=(0, len(networks)), ylim=(len(outcomes), 0))
    psnr = {name: f"\n{value:.1f} dB" for name, value in standard_psnr.items()}
    wrapped = [name.replace("_", "\n", 1).replace("_", " ") for name in networks]
    heads = [head + psnr.get(name, "") for head, name in zip(wrapped, networks, strict=True)]
    axes.set_xticks(np.arange(len(networks)) + 0.5, heads, fontsize=9)
    axes.xaxis.tick_top()
    axes.set_yticks(np.arange(len(outcomes)) + 0.5, labels, fontsize=9)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    figure.supxlabel(LEGEND, fontsize=8)
    return save_figure(figure, path)


def map_limit_ratio_to_colour(result: StressResult) -> float:
    """Return 0..1, 0.5 at the limit: the logarithm of the ratio to the limit, cut at 10 times.

    Where the limit is 0, of the value in units of 0.01; where higher is better, of what is missing
    to 100 % against what may be missing.
    """
    value, limit = result.value, result.limit
    if not math.isfinite(value):
        return 1.0
    if limit == 0 and value == 0:
        return 0.2
    if limit == 0:
        decades = (-value if result.higher_is_better else value) / 0.01
    else:
        if result.higher_is_better:
            value, limit = 100 - value, 100 - limit
        decades = math.log10(max(value, 1e-9) / limit)
    return 0.5 + 0.5 * max(-1.0, min(1.0, decades))


def _draw_cell(axes, row: int, column: int, outcome: StressResult | str) -> None:
    box: dict[str, Any] = {"edgecolor": "white", "linewidth": 2}
    if isinstance(outcome, str):
        axes.add_patch(Rectangle((column, row), 1, 1, **box, **NOT_RUN))
        return
    shade = map_limit_ratio_to_colour(outcome)
    axes.add_patch(Rectangle((column, row), 1, 1, **box, facecolor=COLOURS(shade)))
    style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 9}
    style["color"] = "white" if shade > 0.85 or shade < 0.15 else "black"
    style["weight"] = "bold" if outcome.failed else "normal"
    axes.text(column + 0.5, row + 0.5, format_value(outcome.value, outcome.limit), **style)
