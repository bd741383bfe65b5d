"""Accuracy against time, a panel for each metric with its Pareto front."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import fmean

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from src.bench.speed import SpeedMeasurement
from src.bench.speed_accuracy import ClipScore, find_fastest_forms, find_pareto_front
from src.figures.plots import MARKERS, save_figure
from src.metrics.table import METRICS, Column

PAPER_MS, LIVE_MS = 3.4, 1000 / 600
DRAWN = tuple(metric for metric in METRICS if metric.name != "psnr")  # aligned PSNR stands for it
# Twelve that stay apart, also for the colour-blind, in pairs of dark and light.
PALETTE = (
    "#1f5fa8", "#d1571b", "#2f8f4e", "#8a4fa3", "#c2a11a", "#6b6b6b",
    "#5aa9e6", "#f0a067", "#7fc99a", "#c49ad6", "#8c5a3c", "#000000",
)  # fmt: skip
FILL_STYLES = {
    "float32": "full", "bf16": "none", "compiled": "bottom", "onnx": "left", "openvino": "right",
}  # fmt: skip


def draw_accuracy_against_time(
    path: Path, speeds: Sequence[SpeedMeasurement], scores: Sequence[ClipScore], *, side: int,
    title: str,
) -> Path:  # fmt: skip
    """Draw the float32 scores of every network at the thread time of its fastest form on frames of
    `side`; the dashed line is the Pareto front.
    """
    names = list(dict.fromkeys(score.network for score in scores))
    fastest = find_fastest_forms(speeds, side)
    metrics = [metric for metric in DRAWN if scores and metric.name in scores[0].values]
    rows = max(2, (len(metrics) + 1) // 2)
    figure = Figure(figsize=(11, 4.1 * rows))
    panels = figure.subplots(rows, 2).flat
    for metric, axes in zip(metrics, panels, strict=False):
        _draw_metric(axes, names, fastest, scores, metric)
    for axes in panels:  # those that are left
        axes.set_visible(False)
    figure.supxlabel(f"ms a frame of {side}x{side}, one CPU thread, fastest form")
    figure.suptitle(title)
    forms = [form for form in FILL_STYLES if any(s.form == form for s in fastest.values())]
    _draw_legend(figure, names, forms)
    return save_figure(figure, path)


def _draw_metric(
    axes, names: list[str], fastest: Mapping[str, SpeedMeasurement], scores: Sequence[ClipScore],
    metric: Column,
) -> None:  # fmt: skip
    points: dict[str, tuple[float, float]] = {}
    for index, name in enumerate(names):
        if (timed := fastest.get(name)) and timed.ms:
            values = [score.values[metric.name] for score in scores if score.network == name]
            points[name] = timed.ms, fmean(values)
            axes.plot(*points[name], linestyle="none", **_style(index, timed.form))
    errors = {key: (ms, -metric.better * value) for key, (ms, value) in points.items()}
    front = np.array([points[key] for key in find_pareto_front(errors)]).reshape(-1, 2)
    axes.plot(*front.T, color="0.35", ls="--", lw=1.2, zorder=0)
    place = {"rotation": 90, "fontsize": 7, "color": "0.4", "ha": "right", "va": "top"}
    for ms, text in ((PAPER_MS, "the paper: 3.4 ms"), (LIVE_MS, "600 fps live")):
        axes.axvline(ms, color="0.6", lw=0.8, ls=":")
        axes.text(ms, 0.985, f"{text} ", transform=axes.get_xaxis_transform(), **place)
    side = "higher" if metric.better > 0 else "lower"
    axes.set_title(f"{metric.heading}  ({side} is better)")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.25)


def _style(index: int, form: str) -> dict:
    colour = PALETTE[index % len(PALETTE)]
    return {
        "color": colour, "marker": MARKERS[index % len(MARKERS)], "markersize": 7,
        "fillstyle": FILL_STYLES[form], "markerfacecoloralt": "white", "markeredgecolor": colour,
    }  # fmt: skip


def _draw_legend(figure: Figure, names: Sequence[str], forms: Sequence[str]) -> None:
    handles = [
        Line2D([], [], linestyle="none", **_style(i, "float32"), label=name.replace("_", " "))
        for i, name in enumerate(names)
    ]
    for form in forms:
        style = _style(0, form) | {"color": "0.3", "markeredgecolor": "0.3"}
        handles.append(Line2D([], [], linestyle="none", **style, label=form))
    figure.legend(handles=handles, loc="outside right center", fontsize=9, frameon=False)
