"""Learning curves: a panel for each score of the validation clips, over hours of training."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from src.figures.plots import MARKERS, save
from src.metrics.table import METRICS


def draw(path: Path, curves: Mapping[str, Sequence[Mapping[str, float]]]) -> Path:
    """Draw the lines of curve.csv (src/training/curve.py) of every training, under its name.

    Raises ValueError where there is nothing to draw.
    """
    if not any(curves.values()):
        raise ValueError("curves must have a line or more, got none")
    names = {name for rows in curves.values() for row in rows for name in row}
    shown = [metric for metric in METRICS if metric.name in names]
    figure = Figure(figsize=(3.4 * len(shown), 3.4), layout="constrained")
    for axes, metric in zip(figure.subplots(1, len(shown), squeeze=False)[0], shown, strict=True):
        for (name, rows), marker in zip(curves.items(), MARKERS * len(curves), strict=False):
            there = [row for row in rows if metric.name in row]
            hours, values = ([row[key] for row in there] for key in ("hours", metric.name))
            axes.plot(hours, values, marker=marker, markersize=3, linewidth=1.2, label=name)
        axes.set_title(f"{metric.heading} {metric.arrow}", fontsize=10)
        axes.grid(alpha=0.3)
    figure.supxlabel("hours of training", fontsize=9)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return save(figure, path)
