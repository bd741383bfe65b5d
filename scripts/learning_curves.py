"""Learning curves as a figure: python -m scripts.learning_curves FOLDER ... [--out FILE]

Each FOLDER is a run of src.train with a curve.csv, or has such runs below it: the parts of one
training of a campaign, of which the newest curve has all lines.
"""

import argparse
import csv
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from src.app.script import run_script
from src.figures.plots import MARKERS, save_figure
from src.metrics.table import ARROWS, METRICS

Curve = Sequence[Mapping[str, float]]


def read_curve(folder: Path) -> Curve:
    """Return the lines of the newest curve.csv in `folder` or below; none where there is none."""
    files = sorted(folder.rglob("curve.csv"), key=lambda path: path.stat().st_mtime)
    if not files:
        return []
    with files[-1].open() as file:
        rows = csv.DictReader(file)
        return [{name: float(value or "nan") for name, value in row.items()} for row in rows]


def draw_curves(path: Path, curves: Mapping[str, Curve]) -> Path:
    """Draw the learning curve of every training, by name: a panel for each validation score.

    Raises ValueError where there is nothing to draw.
    """
    if not any(curves.values()):
        raise ValueError("curves must have a line or more, got none")
    names = {name for rows in curves.values() for row in rows for name in row}
    metrics = [metric for metric in METRICS if metric.name in names]
    figure = Figure(figsize=(3.4 * len(metrics), 3.4), layout="constrained")
    panels = figure.subplots(1, len(metrics), squeeze=False)[0]
    for axes, metric in zip(panels, metrics, strict=True):
        for (name, rows), marker in zip(curves.items(), MARKERS * len(curves), strict=False):
            scored = [row for row in rows if metric.name in row]
            hours, values = ([row[key] for row in scored] for key in ("hours", metric.name))
            axes.plot(hours, values, marker=marker, markersize=3, linewidth=1.2, label=name)
        axes.set_title(metric.heading_with_unit + ARROWS[metric.better], fontsize=10)
        axes.grid(alpha=0.3)
    figure.supxlabel("hours of training", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return save_figure(figure, path)


def name_folders(folders: Sequence[Path]) -> list[str]:
    """Return the end of each path, as short as makes all of them differ."""
    paths = [folder.resolve() for folder in folders]
    most = max(len(path.parts) for path in paths)
    ends = ([str(Path(*path.parts[-n:])) for path in paths] for n in range(1, most + 1))
    return next(names for names in ends if len(set(names)) == len(set(paths)))


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, default=Path("out/learning.png"))
    given = parser.parse_args()
    curves = zip(name_folders(given.folders), map(read_curve, given.folders), strict=True)
    print(draw_curves(given.out, dict(curves)))


if __name__ == "__main__":
    run_script(main)
