"""Speed against accuracy: one panel a metric, the front drawn; and speed against arithmetic."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from src.bench.charting import Score
from src.bench.pareto import front
from src.bench.speed import Speed
from src.figures.plots import MARKERS, save
from src.metrics.table import METRICS, Metric

PAPER_MS, LIVE_MS = 3.4, 1000 / 600
LEAST_GMAC = 1e-3
SHOWN = tuple(metric for metric in METRICS if metric.name != "psnr")  # aligned PSNR stands for it
# Twelve that stay apart, also for the colour-blind, in pairs of dark and light.
PALETTE = (
    "#1f5fa8", "#d1571b", "#2f8f4e", "#8a4fa3", "#c2a11a", "#6b6b6b",
    "#5aa9e6", "#f0a067", "#7fc99a", "#c49ad6", "#8c5a3c", "#000000",
)  # fmt: skip
FACES = {
    "float32": "full",
    "bf16": "none",
    "compiled": "bottom",
    "onnx": "left",
    "openvino": "right",
}


def accuracy(
    path: Path, speeds: Sequence[Speed], scores: Sequence[Score], *, side: int, title: str
) -> Path:
    """Draw every scored network at its thread time on pictures of `side`, filled in float32, open
    in bf16; the dashed line is the front of what none beats in both.
    """
    names = list(dict.fromkeys(row.network for row in scores))
    alone = [s for s in speeds if (s.side, s.threads, s.device) == (side, 1, "cpu")]
    times = {(s.network, s.form): s.ms for s in alone if s.ms is not None}
    metrics = [metric for metric in SHOWN if scores and metric.name in scores[0].values]
    rows = max(2, (len(metrics) + 1) // 2)
    figure = Figure(figsize=(11, 4.1 * rows), layout="constrained")
    panels = figure.subplots(rows, 2)
    for axes, metric in zip(panels.flat, metrics, strict=False):
        _panel(axes, names, times, scores, metric)
    for axes in panels.flat[len(metrics) :]:
        axes.set_visible(False)
    figure.supxlabel(f"ms a frame of {side}x{side}, one CPU thread")
    figure.suptitle(title)
    _legend(figure, names, [*FACES][:2], [])
    return save(figure, path)


def machine(path: Path, speeds: Sequence[Speed], peaks: Mapping[tuple[str, int], float]) -> Path:
    """Draw milliseconds over multiply-accumulates, a panel for each number of threads.

    The lines are what the measured peak of a large convolution allows.  Networks without weights
    carry an asterisk; what hardly multiplies, as the high-pass, has no place here.
    """
    timed = [s for s in speeds if s.ms and (s.gmac or 0) > LEAST_GMAC and s.device == "cpu"]
    counts = sorted({s.threads for s in timed}) or [1]
    names = list(dict.fromkeys(s.network for s in speeds))
    starred = {s.network for s in speeds if not s.trained}
    figure = Figure(figsize=(5.2 * len(counts) + 2.4, 5.6), layout="constrained")
    for axes, count in zip(figure.subplots(1, len(counts), squeeze=False)[0], counts, strict=True):
        for s in (s for s in timed if s.threads == count):
            look = _look(names.index(s.network), s.form)
            axes.plot(s.gmac, s.ms, linestyle="none", **look)
        _peaks(axes, peaks, count, [s.gmac for s in timed])
        axes.set(xscale="log", yscale="log", xlabel="GMAC a frame", ylabel="ms a frame")
        _ticks(axes.xaxis, axes.yaxis)
        axes.set_title(f"{count} thread{'s' * (count > 1)}", fontsize=11)
        axes.grid(alpha=0.25, which="major")
    forms = [form for form in FACES if any(s.form == form for s in timed)]
    _legend(figure, names, forms, starred)
    return save(figure, path)


def _panel(axes, names: list[str], times: Mapping, scores: Sequence[Score], metric: Metric) -> None:
    points: dict[tuple[str, str], tuple[float, float]] = {}
    for name in names:
        pair = []
        for form in ("float32", "bf16"):
            values = [r.values[metric.name] for r in scores if (r.network, r.form) == (name, form)]
            if values and (name, form) in times:
                points[name, form] = times[name, form], sum(values) / len(values)
                pair.append(points[name, form])
                axes.plot(*pair[-1], linestyle="none", **_look(names.index(name), form))
        colour = _look(names.index(name), "float32")["color"]
        axes.plot(*zip(*pair, strict=True), color=colour, lw=0.8, alpha=0.6) if pair else None
    best = front({key: (ms, -metric.better * value) for key, (ms, value) in points.items()})
    steps = [points[key] for key in best]
    if steps:
        axes.plot(*zip(*steps, strict=True), color="0.35", ls="--", lw=1.2, zorder=0)
    for ms, text in ((PAPER_MS, "the paper, on a GPU: 3.4 ms"), (LIVE_MS, "600 fps live")):
        axes.axvline(ms, color="0.6", lw=0.8, ls=":")
        axes.text(
            ms, 0.985, f"{text} ", transform=axes.get_xaxis_transform(), rotation=90, fontsize=7,
            color="0.4", ha="right", va="top",
        )  # fmt: skip
    side = "higher" if metric.better > 0 else "lower"
    axes.set(xscale="log", title=f"{metric.heading}  ({side} is better)")
    _ticks(axes.xaxis)
    axes.title.set_fontsize(10)
    axes.grid(alpha=0.25)


def _peaks(axes, peaks: Mapping[tuple[str, int], float], count: int, macs: list[float]) -> None:
    """Draw the lines of arithmetic for this number of threads."""
    ends = [min(macs), max(macs)] if macs else [1, 10]
    for form, style in (("float32", "-"), ("bf16", "--")):
        if (form, count) in peaks:
            speed = peaks[form, count] / 1e9
            label = f"{form} limit: {speed:.0f} GMAC/s"
            times = [1e3 * gmac / speed for gmac in ends]
            axes.plot(ends, times, color="0.4", ls=style, lw=1, label=label)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=8, loc="lower right", frameon=False)


def _ticks(*axes) -> None:
    for axis in axes:
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())


def _look(place: int, form: str) -> dict:
    colour = PALETTE[place % len(PALETTE)]
    face = FACES[form]
    look = {"color": colour, "marker": MARKERS[place % len(MARKERS)], "markersize": 7}
    return look | {"fillstyle": face, "markerfacecoloralt": "white", "markeredgecolor": colour}


def _legend(figure: Figure, names: list[str], forms: Sequence[str], starred) -> None:
    stars = ["  * no weights" if name in starred else "" for name in names]
    labels = [name.replace("_", " ") + star for name, star in zip(names, stars, strict=True)]
    handles = [
        Line2D([], [], linestyle="none", **_look(i, "float32"), label=label)
        for i, label in enumerate(labels)
    ]
    for form in forms:
        look = {"color": "0.3", "marker": "o", "fillstyle": FACES[form], "markersize": 7}
        look |= {"markerfacecoloralt": "white", "linestyle": "none"}
        handles.append(Line2D([], [], **look, label=form))
    figure.legend(handles=handles, loc="outside right center", fontsize=9, frameon=False)
