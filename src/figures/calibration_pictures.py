"""Pictures of a calibration: the views on the sensor, and the turbulence seen through them."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from src.figures import plots
from src.recordings.calibration.alignment import Alignment, Found
from src.recordings.calibration.statistics import Statistics, decay_s
from src.recordings.views import Views

MAGNIFIED = 60  # residuals are drawn this many times too long
LABEL = {"facecolor": "white", "edgecolor": "none", "pad": 1.5}


def views_found(picture: UInt8[np.ndarray, "h w"], corners: Found, path: Path) -> None:
    """Draw where the target was found on the sensor: what a failed calibration leaves behind."""
    figure, axes = _sensor(picture)
    for position, points in corners.points.items():
        axes.plot(*points.T, ".", markersize=5, color="tab:red")
        x, y = np.nanmean(points[:, 0]), np.nanmin(points[:, 1]) - 45
        axes.text(x, y, str(position), color="black", ha="center", fontsize=8, bbox=LABEL)
    axes.set_title(f"target found in {len(corners.points)} views")
    plots.save(figure, Path(path))


def views_aligned(picture: UInt8[np.ndarray, "h w"], alignment: Alignment, path: Path) -> None:
    """Draw the outline of every view, its error, and its residuals as lines from each point."""
    figure, axes = _sensor(picture)
    for view in alignment.views.views:
        _outline(axes, alignment.views, view)
        points, residuals = alignment.points[view.position], alignment.residuals[view.position]
        inward = residuals @ np.linalg.inv(view.homography[:2, :2]).T  # to this view's pixels
        ends = points + MAGNIFIED * inward
        for start, end in zip(points, ends, strict=True):
            axes.plot(*np.stack([start, end]).T, color="red", linewidth=1.4)
    axes.set_title(f"views in the sensor's pixels; residuals in red, {MAGNIFIED} times too long")
    plots.save(figure, Path(path))


def views_by_hand(picture: UInt8[np.ndarray, "h w"], views: Views, path: Path) -> None:
    """Draw the outline of every view."""
    figure, axes = _sensor(picture)
    for view in views.views:
        _outline(axes, views, view)
    plots.save(figure, Path(path))


def _sensor(picture: np.ndarray) -> tuple[Figure, Axes]:
    height, width = picture.shape
    figure = Figure(figsize=(10, 10 * height / width + 0.5), layout="constrained")
    axes = figure.add_subplot()
    axes.imshow(picture, cmap="gray")
    return figure, axes


def _outline(axes: Axes, views: Views, view) -> None:
    outline = views.outline(view)
    closed = np.vstack([outline, outline[:1]])
    axes.plot(*closed.T, color="tab:green", linewidth=1)
    axes.plot(*outline[0], "o", color="tab:green", markersize=5)  # the field's top left corner
    row, col = view.position
    error = f"{view.error_px:.2f} px" if view.position != (0, 0) else "the reference"
    text = f"({row}, {col}) {error}"
    x, y = outline[:, 0].mean(), outline[:, 1].min() + 12
    axes.text(x, y, text, color="black", ha="center", fontsize=8, bbox=LABEL)


def turbulence(statistics: Statistics, positions: list[tuple[int, int]], path: Path) -> None:
    """Draw the five panels of the paper's supplement: autocorrelation of tilt, its correlation
    within the centre view and across views, blur over time, intensity over time."""
    figure = Figure(figsize=(17, 3.6), layout="constrained")
    panels = figure.subplots(1, 5)
    _autocorrelation(panels[0], statistics)
    dots = statistics.tilt.shape[2]
    _matrix(panels[1], statistics.within_view, "(b) tilt between dots, centre view", range(dots))
    names = [f"{row},{col}" for row, col in positions]
    _matrix(panels[2], statistics.across_views, "(c) tilt between views, middle dot", names)
    view, dot = statistics.centre, statistics.middle
    time = np.arange(statistics.blur.shape[1]) / statistics.fps
    _blur(panels[3], time, statistics.blur[view, :, dot], statistics.still_blur[view, dot])
    _intensity(panels[4], statistics, view, dot)
    failed = int(statistics.failed.sum())
    figure.suptitle(f"{statistics.blur.size} fits, {failed} failed", fontsize=9)
    plots.save(figure, Path(path))


def _autocorrelation(axes: Axes, statistics: Statistics) -> None:
    values = statistics.autocorrelation
    axes.plot(statistics.lags_s, values)
    axes.axhline(0, color="gray", linewidth=0.5)
    axes.set(xlabel="lag (s)", ylabel="correlation", ylim=(-0.6, 1.05))
    axes.set_title(f"(a) tilt in time, 1/e at {decay_s(values, statistics.fps):.3f} s", fontsize=9)


def _matrix(axes: Axes, matrix: Float[np.ndarray, "k k"], title: str, names) -> None:
    shown = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)
    axes.set_xticks(range(len(matrix)), names, fontsize=6, rotation=60)
    axes.set_yticks(range(len(matrix)), names, fontsize=6)
    axes.set_title(title, fontsize=9)


def _blur(axes: Axes, time: np.ndarray, blur: np.ndarray, still: float) -> None:
    axes.plot(time, blur, linewidth=0.8, label="turbulence")
    axes.axhline(still, color="gray", label="without")
    axes.set(xlabel="time (s)", ylabel="mean spread (px)")
    axes.set_title(f"(d) blur, ratio {np.nanmean(blur) / still:.2f}", fontsize=9)
    axes.legend(fontsize=7)


def _intensity(axes: Axes, statistics: Statistics, view: int, dot: int) -> None:
    for series, name in (
        (statistics.intensity[view, :, dot], "turbulence"),
        (statistics.still_intensity[view, :, dot], "without"),
    ):
        axes.plot(np.arange(len(series)) / statistics.fps, series, linewidth=0.8, label=name)
    with_, without = statistics.scintillation[view, dot], statistics.still_scintillation[view, dot]
    axes.set(xlabel="time (s)", ylabel="I / <I>")
    axes.set_title(f"(e) scintillation {with_:.1e}, without {without:.0e}", fontsize=9)
    axes.legend(fontsize=7)
