"""The map of the sweep `turbulence`: python -m scripts.turbulence_map out/sweep/turbulence

Over tilt amplitude and correlation length: by how much nine views beat one in LPIPS and aligned
PSNR, and how many views SetNet needs.  [--out FILE]
"""

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from src.app.script import run_script
from src.figures.plots import save_figure
from src.metrics.bootstrap import bootstrap_difference_interval
from src.records import runs
from src.records.results import list_sources
from src.records.runs import Run
from src.reports.differences import pool_same_clips

SETNET = {1: "setnet_one", 3: "setnet_three", 5: "setnet_five", 9: "setnet_nine"}
LPIPS_TOLERANCE = 0.005  # above that of nine views
ATMOSPHERE = "turbulence.atmosphere"
PALE = 1.8  # times the largest value are the ends of the colours: text is read on all cells
Setting = tuple[float, float]  # half length of the tilt, its spread, px
RunsBySetting = dict[Setting, dict[str, Run]]
Cells = dict[Setting, tuple[float, str]]  # value, text


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
    """Return ours - theirs; a star where the 95 % bootstrap CI excludes zero.  Raises ValueError
    where the clips of both are not the same."""
    cells = {}
    for setting, by_name in grouped.items():
        if ours in by_name and theirs in by_name:
            pooled = pool_same_clips("folders", [by_name[ours]], [by_name[theirs]])
            sides = [[[float(clip[metric]) for clip in clips] for clips in side] for side in pooled]
            value = sum(sides[0][0]) / len(sides[0][0]) - sum(sides[1][0]) / len(sides[1][0])
            low, high = bootstrap_difference_interval(*sides, groups=list_sources(pooled[0][0]))
            cells[setting] = (value, f"{value:+.{digits}f}" + ("*" if low * high > 0 else ""))
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


def draw_maps(path: Path, maps: Mapping[str, Cells]) -> Path:
    """Draw a panel for each of `maps`, two side by side, purple below zero and orange above; cells
    without a value are grey.
    """
    settings = {setting for cells in maps.values() for setting in cells}
    halves, spreads = (sorted({setting[axis] for setting in settings}) for axis in (0, 1))
    rows = math.ceil(len(maps) / 2)
    size = 0.6 + 1.5 * len(halves), 0.5 + (0.7 + 0.4 * len(spreads)) * rows
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(rows, 2, squeeze=False).flatten()
    for axes in panels[len(maps) :]:
        axes.set_axis_off()
    for axes, (title, cells) in zip(panels, maps.items(), strict=False):
        values = np.full((len(spreads), len(halves)), np.nan)
        for (half, spread), (value, text) in cells.items():
            column, row = halves.index(half), spreads.index(spread)
            values[row, column] = value
            axes.text(column, row, text, ha="center", va="center", fontsize=8)
        most = PALE * max(float(np.nanmax(np.abs(values))), 1e-9)
        axes.set_facecolor("#dddddd")
        axes.imshow(values, "PuOr_r", vmin=-most, vmax=most, origin="lower", aspect="auto")
        axes.set_xticks(range(len(halves)), [f"{half:g}" for half in halves])
        axes.set_yticks(range(len(spreads)), [f"{spread:g}" for spread in spreads])
        axes.set_title(title, fontsize=9)
    figure.supxlabel("half length of the tilt, px", fontsize=9)
    figure.supylabel("tilt and blur, px", fontsize=9)
    return save_figure(figure, path)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/turbulence_map.png"))
    given = parser.parse_args()
    grouped = group_runs(runs.find_runs(given.folders))
    lf, setnet = ("lf3x3", "single256"), (SETNET[9], SETNET[1])
    maps = {
        "E2VID, Δ (9 − 1 views): LPIPS": compute_differences(grouped, *lf, "lpips", 3),
        "the same: aligned PSNR, dB": compute_differences(grouped, *lf, "psnr_aligned", 2),
        "SetNet, Δ (9 − 1 views): LPIPS": compute_differences(grouped, *setnet, "lpips", 3),
        "views needed": count_views_needed(grouped),
    }
    print(draw_maps(given.out, {title: cells for title, cells in maps.items() if cells}))


if __name__ == "__main__":
    run_script(main)
