"""The map of the sweep `turbulence`: python -m scripts.turbulence_map out/sweep/turbulence

Over tilt amplitude and correlation length: by how much nine views beat one in LPIPS and aligned
PSNR, and how many views SetNet needs.  [--out FILE]
"""

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from src.app.script import run_script
from src.figures.plots import save_figure
from src.metrics.table import METRICS
from src.records import runs
from src.records.runs import Run
from src.reports.differences import compare_clips, pool_same_clips

SETNET = {1: "setnet_one", 3: "setnet_three", 5: "setnet_five", 9: "setnet_nine"}
LPIPS_TOLERANCE = 0.005  # above that of nine views
ATMOSPHERE = "turbulence.atmosphere"
PALE = 1.8  # times the largest value are the ends of the colours: text is read on all cells
KEY = """half length of the tilt, px

purple: nine views are better, orange: worse, *: 95 % CI without zero; grey: fewest views"""
Setting = tuple[float, float]  # half length of the tilt, its spread, px
RunsBySetting = dict[Setting, dict[str, Run]]
Cells = dict[Setting, tuple[float, str]]  # value, text


@dataclass(frozen=True)
class Panel:
    """Cells under a title: differences of `metric`, or, without one, numbers of views."""

    title: str
    cells: Cells
    metric: str = ""


def group_runs(found: Sequence[Run]) -> RunsBySetting:
    """Return the runs by (half length, spread) in pixels and by name; ValueError for a second run
    of a name at one setting, such as of another seed."""
    grouped: RunsBySetting = {}
    for run in found:
        half = run.settings[f"{ATMOSPHERE}.tilt_correlation_half_length_px"]
        spread = run.settings[f"{ATMOSPHERE}.tilt_and_blur_px.strong"]
        by_name, name = grouped.setdefault((half[0], spread[0]), {}), run.record["experiment"]
        if name in by_name:
            got = f"{by_name[name].folder} and {run.folder}"
            raise ValueError(f"folders must hold one run of {name} for each setting, got {got}")
        by_name[name] = run
    return grouped


def compute_differences(
    grouped: RunsBySetting, ours: str, theirs: str, metric: str, digits: int
) -> Cells:
    """Return ours - theirs over the clips that both have scores of, no cell without one; a star
    where the 95 % bootstrap CI excludes zero.  Raises ValueError where the clips of both are not
    the same."""
    cells = {}
    for setting, by_name in grouped.items():
        if ours not in by_name or theirs not in by_name:
            continue
        pooled = pool_same_clips("folders", [by_name[ours]], [by_name[theirs]])
        if compared := compare_clips(*pooled, metric):
            change, (low, high) = compared.ours - compared.theirs, compared.interval
            cells[setting] = (change, f"{change:+z.{digits}f}" + ("*" if low * high > 0 else ""))
    return cells


def count_views_needed(grouped: RunsBySetting) -> Cells:
    """Return the fewest views whose mean LPIPS is within LPIPS_TOLERANCE of that of nine."""
    cells = {}
    for setting, by_name in grouped.items():
        if all(name in by_name for name in SETNET.values()):
            lpips = {n: by_name[name].record["test"]["lpips"]["mean"] for n, name in SETNET.items()}
            fewest = min(n for n in SETNET if lpips[n] <= lpips[9] + LPIPS_TOLERANCE)
            cells[setting] = (float(fewest), str(fewest))
    return cells


def draw_maps(path: Path, panels: Sequence[Panel]) -> Path:
    """Draw the panels, two side by side: purple where more views are better, orange where they are
    worse, those of one metric on one scale; numbers of views in grey.  Cells without a value are
    hatched.
    """
    settings = {setting for panel in panels for setting in panel.cells}
    halves, spreads = (sorted({setting[axis] for setting in settings}) for axis in (0, 1))
    rows = math.ceil(len(panels) / 2)
    size = 0.6 + 1.5 * len(halves), 0.8 + (0.7 + 0.4 * len(spreads)) * rows
    figure = Figure(figsize=size, layout="constrained")
    places = figure.subplots(rows, 2, squeeze=False).flatten()
    for axes in places[len(panels) :]:
        axes.set_axis_off()
    for axes, panel in zip(places, panels, strict=False):
        alike = [one.cells for one in panels if one.metric == panel.metric]
        most = max(abs(value) for cells in alike for value, _ in cells.values())
        _draw_panel(axes, panel, halves, spreads, PALE * max(most, 1e-9))
    figure.supxlabel(KEY, fontsize=9)
    figure.supylabel("tilt and blur, px", fontsize=9)
    return save_figure(figure, path)


def _draw_panel(
    axes: Axes, panel: Panel, halves: list[float], spreads: list[float], end: float
) -> None:
    """Draw a panel whose colours end at `end`."""
    better = {metric.name: metric.better for metric in METRICS}.get(panel.metric, 1)
    colours, low, high = ("PuOr", -end, end) if panel.metric else ("Greys", 0, 2 * end)
    values = np.full((len(spreads), len(halves)), np.nan)
    for (half, spread), (value, text) in panel.cells.items():
        column, row = halves.index(half), spreads.index(spread)
        values[row, column] = better * value
        axes.text(column, row, text, ha="center", va="center", fontsize=8)
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.7")
    axes.imshow(values, colours, vmin=low, vmax=high, origin="lower", aspect="auto")
    axes.set_xticks(range(len(halves)), [f"{half:g}" for half in halves])
    axes.set_yticks(range(len(spreads)), [f"{spread:g}" for spread in spreads])
    axes.set_title(panel.title, fontsize=9)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/turbulence_map.png"))
    given = parser.parse_args()
    grouped = group_runs(runs.find_runs(given.folders))
    lf, setnet = ("lf3x3", "single256"), (SETNET[9], SETNET[1])
    nine_less_one = {
        "E2VID, Δ (9 − 1 views): LPIPS": (*lf, "lpips", 3),
        "E2VID, Δ (9 − 1 views): aligned PSNR, dB": (*lf, "psnr_aligned", 2),
        "SetNet, Δ (9 − 1 views): LPIPS": (*setnet, "lpips", 3),
    }
    panels = [
        Panel(title, compute_differences(grouped, *chosen), chosen[2])
        for title, chosen in nine_less_one.items()
    ]
    title = f"SetNet: views within {LPIPS_TOLERANCE} LPIPS of nine"
    panels.append(Panel(title, count_views_needed(grouped)))
    print(draw_maps(given.out, [panel for panel in panels if panel.cells]))


if __name__ == "__main__":
    run_script(main)
