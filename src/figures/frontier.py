"""Accuracy against time, a panel for each of two scores with its Pareto front."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation
from matplotlib.ticker import LogLocator, NullFormatter
from matplotlib.transforms import Bbox

from src.bench.speed import SpeedMeasurement
from src.bench.speed_accuracy import (
    ClipScore,
    compute_standard_error,
    find_fastest_forms,
    find_pareto_front,
)
from src.figures.plots import save_figure
from src.metrics.table import METRICS, Column, mean_score

PAPER_MS, PAPER_SIDE, LIVE_MS = 3.4, 176, 1000 / 600  # the paper's frames are of 176 x 176
DRAWN = tuple(metric for metric in METRICS if metric.name in ("lpips", "psnr_aligned"))
SEVERAL_VIEWS, ONE_VIEW = "#1f5fa8", "#d1571b"
MARKER_PX, CLEARANCE_PX, NAME_GAP_PT = 4, 1, 6  # half of a marker; around a name; to its point
# Where a name may stand, in gaps (right, up): right of the point for one thread, above it or below,
# left of the end of its line.
NAME_PLACES = tuple((dx, dy) for dy in (0, 1, -1, 2, -2, 3, -3) for dx in (1, 0, -1) if dx or dy)
Span = tuple[float, float, float]  # least ms of any number of threads, ms of one, score


def draw_accuracy_against_time(
    path: Path, speeds: Sequence[SpeedMeasurement], scores: Sequence[ClipScore], *, side: int,
    title: str,
) -> Path:  # fmt: skip
    """Draw the float32 scores of every network at the thread time of its fastest form on frames of
    `side`, with a line to its fastest time on more threads; the dashed line is the Pareto front.
    The bars are the standard error of the difference to the best network on the same clips.
    The title ends with the number of clips; the paper's time is drawn at its own size.
    """
    timed = find_fastest_forms(speeds, side)
    metrics = [metric for metric in DRAWN if scores and metric.name in scores[0].values]
    figure = Figure(figsize=(14, 6))
    panels = figure.subplots(1, max(len(metrics), 1), squeeze=False)[0]
    pairs = list(zip(panels, metrics, strict=False))
    marks = {LIVE_MS: "600 frames a second"}
    marks |= {PAPER_MS: f"the paper: {PAPER_MS} ms"} if side == PAPER_SIDE else {}
    for axes in panels[: len(metrics)]:
        _mark_times(axes, marks)
    spans = [_draw_metric(axes, metric, timed, speeds, scores) for axes, metric in pairs]
    threads = sorted({s.threads for s in speeds if s.threads > 1})
    more = f"; lines: to {' and '.join(map(str, threads))} threads" if threads else ""
    figure.supxlabel(
        f"ms from events to a frame of {side}x{side}, one CPU thread{more}",
        fontsize=10, x=0.02, ha="left",
    )  # fmt: skip
    clips = len({(score.severity, score.clip) for score in scores})
    figure.suptitle(f"{title}, {clips} clip{'s' * (clips != 1)}")
    _draw_legend(figure, timed)
    figure.draw_without_rendering()  # places the panels, by which names keep their distance
    for axes, placed in zip(panels, spans, strict=False):
        _name_points(axes, placed)
    return save_figure(figure, path)


def _draw_metric(
    axes: Axes, metric: Column, timed: Mapping[str, SpeedMeasurement],
    speeds: Sequence[SpeedMeasurement], scores: Sequence[ClipScore],
) -> dict[str, Span]:  # fmt: skip
    """Draw the panel of `metric`, all but names; return where each network is."""
    spans: dict[str, Span] = {}
    standard_errors = compute_standard_errors(metric, scores)
    for name, fastest in timed.items():
        values = [score.values[metric.name] for score in scores if score.network == name]
        mean = mean_score(values)
        if mean is not None and fastest.ms:
            least = min(s.ms for s in speeds if s.ms and _is_like(s, fastest))
            spans[name] = least, fastest.ms, mean
            line, colour = ([least, fastest.ms], [spans[name][2]] * 2), _colour(fastest)
            axes.plot(*line, "o-", markevery=[1], color=colour, lw=1.2)
            error = standard_errors.get(name, 0.0)
            if error > 0:
                axes.vlines(fastest.ms, mean - error, mean + error, color=colour, lw=0.8)
    errors = {key: (ms, -metric.better * score) for key, (_, ms, score) in spans.items()}
    front = np.array([spans[key][1:] for key in find_pareto_front(errors)]).reshape(-1, 2)
    axes.plot(*front.T, color="0.35", ls="--", lw=1, zorder=0)
    side = "higher" if metric.better > 0 else "lower"
    axes.set_title(f"{metric.heading_with_unit}  ({side} is better)")
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.margins(0.12)
    _fit_to_scores(axes, [score for _, _, score in spans.values()])
    axes.grid(alpha=0.25)
    return spans


def _fit_to_scores(axes: Axes, scores: Sequence[float]) -> None:
    """Let `axes` reach a little beyond the scores; long bars are cut."""
    if scores:
        low, high = min(scores), max(scores)
        margin = 0.08 * (high - low or 1.0)
        axes.set_ylim(low - margin, high + margin)


def compute_standard_errors(metric: Column, scores: Sequence[ClipScore]) -> dict[str, float]:
    """Return {network: standard error of its mean difference of `metric` to the best network's},
    over the clips of both, those of one number as one: they show the same in each severity.  None
    where they are fewer than two.
    """
    values: dict[str, dict[tuple[int, str], float]] = {}
    for score in scores:
        value = score.values[metric.name]
        if value is not None and np.isfinite(value):
            values.setdefault(score.network, {})[score.clip, score.severity] = value
    if not values:
        return {}
    best = max(values.values(), key=lambda own: metric.better * np.mean(list(own.values())))
    found = {}
    for name, own in values.items():
        more: dict[int, list[float]] = {}
        for clip, severity in sorted(own.keys() & best.keys()):
            difference = own[clip, severity] - best[clip, severity]
            more.setdefault(clip, []).append(difference)
        if len(more) > 1:
            found[name] = compute_standard_error([float(np.mean(each)) for each in more.values()])
    return found


def _mark_times(axes: Axes, marks: Mapping[float, str]) -> None:
    """Draw a dotted line, with a text, at each time in ms."""
    place: dict[str, Any] = {"rotation": 90, "fontsize": 7, "color": "0.4"}
    place |= {"ha": "right", "va": "top", "transform": axes.get_xaxis_transform()}
    for ms, text in marks.items():
        axes.axvline(ms, color="0.6", lw=0.8, ls=":")
        axes.text(ms, 0.985, f"{text} ", **place)


def _is_like(one: SpeedMeasurement, other: SpeedMeasurement) -> bool:
    """Return whether both are of a network, a size and a device."""
    return all(getattr(one, name) == getattr(other, name) for name in ("network", "side", "device"))


def _colour(timed: SpeedMeasurement) -> str:
    return SEVERAL_VIEWS if timed.views > 1 else ONE_VIEW


def _draw_legend(figure: Figure, timed: Mapping[str, SpeedMeasurement]) -> None:
    named = {_colour(s): "one view" if s.views == 1 else f"{s.views} views" for s in timed.values()}
    handles = [Line2D([], [], ls="none", marker="o", color=c, label=n) for c, n in named.items()]
    handles.append(Line2D([], [], ls="--", lw=1, color="0.35", label="Pareto front"))
    bar: dict[str, Any] = {"marker": "|", "markersize": 11, "markeredgewidth": 0.8, "color": "0.35"}
    what = "standard error of the difference to the best"
    handles.append(Line2D([], [], ls="none", label=what, **bar))
    place: dict[str, Any] = {"loc": "outside lower right", "ncols": 4, "columnspacing": 1}
    figure.legend(handles=handles, **place, frameon=False, fontsize=9)


def _name_points(axes: Axes, spans: Mapping[str, Span]) -> None:
    """Write each name at the first place where it covers nothing, texts of `axes` included, and is
    nearest to its own point, else where it covers and is near to the fewest others; a bar counts
    half."""
    to_px = axes.transData.transform
    lines = [_box(to_px((least, score)), to_px((ms, score))) for least, ms, score in spans.values()]
    taken = lines + [text.get_window_extent() for text in axes.texts]
    bars = [bar.get_window_extent() for bar in axes.collections]
    for (name, span), own in zip(spans.items(), lines, strict=True):
        written = [_write(axes, name, span, place) for place in NAME_PLACES]
        boxes = [text.get_window_extent().padded(CLEARANCE_PX) for text in written]
        faults = [
            box.count_overlaps(taken)
            + 0.5 * box.count_overlaps(bars)
            + (not axes.bbox.x0 < box.x0 < box.x1 < axes.bbox.x1)
            + sum(_gap(box, line) <= _gap(box, own) for line in lines if line is not own)
            for box in boxes
        ]
        best = int(np.argmin(faults))
        taken.append(boxes[best])
        for text in written[:best] + written[best + 1 :]:
            text.remove()


def _write(axes: Axes, name: str, span: Span, place: tuple[int, int]) -> Annotation:
    (least, ms, score), (dx, dy) = span, place
    point, offset = (least if dx < 0 else ms, score), (NAME_GAP_PT * dx, NAME_GAP_PT * dy)
    return axes.annotate(
        name.replace("_", " "), point, offset,
        ha=("center", "left", "right")[dx], va=("center", "bottom", "top")[(dy > 0) - (dy < 0)],
        textcoords="offset points", fontsize=8, color="0.15",
    )  # fmt: skip


def _gap(one: Bbox, other: Bbox) -> float:
    """Return the distance between two boxes, 0 where they overlap."""
    across, down = (
        max(one.x0 - other.x1, other.x0 - one.x1),
        max(one.y0 - other.y1, other.y0 - one.y1),
    )
    return float(np.hypot(max(across, 0), max(down, 0)))


def _box(low: np.ndarray, high: np.ndarray) -> Bbox:
    return Bbox.from_extents(*(low - MARKER_PX), *(high + MARKER_PX))
