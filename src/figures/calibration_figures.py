"""Figures of calibrations: views on the sensor, a dot grid, event rates, measured turbulence."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from src.figures.plots import save_figure
from src.recordings.calibration.contrast_threshold import ThresholdEstimate
from src.recordings.calibration.view_alignment import AlignedViews
from src.recordings.files.turbulence_file import SIDE, IntervalEstimate
from src.recordings.turbulence_measurement.dot_statistics import DotStatistics, decay_time_s
from src.recordings.turbulence_measurement.turbulence_meter import (
    TurbulenceMeasurement,
    longest_decay_frames,
)
from src.recordings.views import Views
from src.sim.optics import Position

RESIDUAL_SCALE, RESIDUAL_PX = 60, 12  # residuals are drawn so many times too long, or as so long
LABEL: dict[str, Any] = {
    "color": "black", "ha": "center", "fontsize": 8,
    "bbox": {"facecolor": "white", "edgecolor": "none", "pad": 1.5},
}  # fmt: skip
DISTANCE_TICKS = (0, 1, 2, 5, 10, 20, 50, 100, 200)
THRESHOLD_TICKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)


def draw_found_target(
    picture: UInt8[np.ndarray, "h w"], found: Mapping[Position, np.ndarray], path: Path
) -> None:
    """Draw where the target was found on the sensor: what a failed calibration leaves behind."""
    figure, axes = _show_sensor(picture)
    for position, points in found.items():
        axes.plot(*points.T, ".", markersize=5, color="tab:red")
        x, y = np.nanmean(points[:, 0]), np.nanmin(points[:, 1]) - 45
        axes.text(x, y, str(position), **LABEL)
    axes.set_title(f"target found in {len(found)} views")
    save_figure(figure, path)


def draw_view_residuals(
    picture: UInt8[np.ndarray, "h w"], alignment: AlignedViews, path: Path
) -> None:
    """Draw the outline of every view, its error, and its residuals as lines from each point."""
    figure, axes = _show_sensor(picture)
    _draw_outlines(axes, alignment.views)
    largest = max(view.error_px for view in alignment.views.views)
    scale = min(RESIDUAL_SCALE, round(RESIDUAL_PX / max(largest, 0.01)))
    for view in alignment.views.views:
        points, residuals = alignment.points[view.position], alignment.residuals[view.position]
        inward = residuals @ np.linalg.inv(view.homography[:2, :2]).T  # to this view's pixels
        ends = points + scale * inward
        axes.plot(*np.stack([points, ends]).transpose(2, 0, 1), color="red", linewidth=1.4)
    axes.set_title(f"views in sensor pixels; residuals in red, {scale} times too long")
    save_figure(figure, path)


def draw_views(picture: UInt8[np.ndarray, "h w"], views: Views, path: Path) -> None:
    """Draw the outline of every view."""
    figure, axes = _show_sensor(picture)
    _draw_outlines(axes, views)
    save_figure(figure, path)


def draw_views_over_centre(
    picture: Float[np.ndarray, "h w"], views: Views, matched: Mapping[Position, float], path: Path
) -> None:
    """Draw each view of a sensor picture over the centre one: what coincides is white, what only
    the view shows magenta, only the centre view green."""
    rows, cols = ([at[axis] for at in views.positions] for axis in (0, 1))
    shape = max(rows) - min(rows) + 1, max(cols) - min(cols) + 1
    seen = dict(zip(views.positions, views.warp_to_model(np.log1p(picture)), strict=True))
    figure = Figure(figsize=(4 * shape[1], 4 * shape[0] * views.model[0] / views.model[1] + 1))
    panels = figure.subplots(*shape, squeeze=False)
    for axes in panels.flat:
        axes.set_axis_off()
    for at in views.positions:
        axes = panels[at[0] - min(rows), at[1] - min(cols)]
        axes.set_axis_on()
        layers = [seen[key] / np.percentile(seen[key], 99.5) for key in (at, (0, 0), at)]
        axes.imshow(np.clip(np.stack(layers, axis=-1), 0, 1))
        axes.set(xticks=[], yticks=[], title=f"{at}: {matched[at]:.0%} matched")
    save_figure(figure, path)


def draw_event_rates(estimate: ThresholdEstimate, path: Path) -> None:
    """Draw event rate against contrast threshold (the paper's supplement): the simulated rates, the
    recording's with their intervals, and where they meet.
    """
    figure = Figure(figsize=(6, 4))
    axes = figure.subplots()
    ratio = estimate.curve.off_ratio
    for side, (name, colour) in enumerate((("ON", "tab:red"), ("OFF", "tab:blue"))):
        at = estimate.curve.thresholds * (ratio if side else 1.0)
        axes.loglog(at, estimate.curve.rates[:, side], color=colour, label=f"simulated {name}")
        axes.axhspan(*estimate.interval[:, side], color=colour, alpha=0.2)
        axes.axhline(estimate.rates[side], color=colour, lw=0.8, ls="--", label=f"recording {name}")
        value, low, high = estimate.off if side else estimate.on
        text = f"{name}: C = {value:.3f} ({low:.3f} to {high:.3f})"
        axes.errorbar(
            value, estimate.rates[side], xerr=[[max(value - low, 0)], [max(high - value, 0)]],
            color=colour, marker="o", capsize=4, label=text,
        )  # fmt: skip
    axes.set(xlabel="contrast threshold C (nat)", ylabel="events / pixel / s")
    axes.set_xticks(THRESHOLD_TICKS, [f"{tick:g}" for tick in THRESHOLD_TICKS])
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    save_figure(figure, path)


def draw_dot_statistics(
    statistics: DotStatistics, positions: Sequence[tuple[int, int]], path: Path
) -> None:
    """Draw the five panels of the paper's supplement: autocorrelation of tilt, its correlation
    within the centre view and across views, blur over time, intensity over time."""
    figure = Figure(figsize=(17, 3.6))
    tilt, within, across, blur, intensity = figure.subplots(1, 5)
    view, dot = statistics.centre_view, statistics.middle_dot
    decay_s = decay_time_s(statistics.middle_dot_autocorrelation, statistics.fps)
    tilt.plot(statistics.lags_s, statistics.middle_dot_autocorrelation)
    tilt.axhline(0, color="gray", linewidth=0.5)
    tilt.set(
        xlabel="lag (s)", ylabel="correlation", ylim=(-0.6, 1.05),
        title=f"(a) tilt in time, 1/e at {decay_s:.3f} s",
    )  # fmt: skip
    dots, names = range(statistics.tilt.shape[2]), [f"{row},{col}" for row, col in positions]
    title = "(b) tilt between dots, centre view"
    _show_correlations(within, statistics.centre_view_correlation, title, dots)
    title = "(c) tilt between views, middle dot"
    _show_correlations(across, statistics.tilt_correlation_across_views, title, names)
    for axes, series, label in (
        (blur, statistics.blur, "turbulence"),
        (intensity, statistics.relative_intensity, "turbulence"),
        (intensity, statistics.still_relative_intensity, "without"),
    ):
        time_s = np.arange(series.shape[1]) / statistics.fps
        axes.plot(time_s, series[view, :, dot], linewidth=0.8, label=label)
    still = statistics.still_blur[view, dot]
    ratio = np.nanmean(statistics.blur[view, :, dot]) / still
    blur.axhline(still, color="gray", label="without")
    blur.set(xlabel="time (s)", ylabel="mean spread (px)", title=f"(d) blur, ratio {ratio:.2f}")
    with_, without = statistics.scintillation[view, dot], statistics.still_scintillation[view, dot]
    title = f"(e) scintillation {with_:.1e}, without {without:.0e}"
    intensity.set(xlabel="time (s)", ylabel="I / <I>", title=title)
    blur.legend()
    intensity.legend()
    failed = int(statistics.failed.sum())
    figure.suptitle(f"{statistics.blur.size} fits, {failed} failed", fontsize=9)
    save_figure(figure, path)


def _show_sensor(picture: np.ndarray) -> tuple[Figure, Axes]:
    height, width = picture.shape
    figure = Figure(figsize=(10, 10 * height / width + 0.5))
    axes = figure.add_subplot()
    axes.imshow(picture)
    return figure, axes


def _draw_outlines(axes: Axes, views: Views) -> None:
    for view in views.views:
        outline, (row, col) = views.outline(view), view.position
        axes.plot(*np.vstack([outline, outline[:1]]).T, color="tab:green", linewidth=1)
        axes.plot(*outline[0], "o", color="tab:green", markersize=5)  # the field's top left corner
        error = f"{view.error_px:.2f} px" if (row, col) != (0, 0) else "the reference"
        x, y = outline[:, 0].mean(), outline[:, 1].min() + 12
        axes.text(x, y, f"({row}, {col}) {error}", **LABEL)


def _show_correlations(axes: Axes, matrix: Float[np.ndarray, "k k"], title: str, names) -> None:
    shown = axes.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)
    axes.set_xticks(range(len(matrix)), names, fontsize=6, rotation=60)
    axes.set_yticks(range(len(matrix)), names, fontsize=6)
    axes.set_title(title)


def draw_measured_turbulence(measured: TurbulenceMeasurement, title: str, path: Path) -> Path:
    """Draw points coloured by rms on the mean frame, and the tilt's correlation over distance and
    over lag, with the 95 % bootstrap CIs of its half length and its decay time.
    """
    figure = Figure(figsize=(16, 4))
    points, distance, lag = figure.subplots(1, 3)
    tilt, fps, found = measured.tilt, measured.fps, measured.found

    points.imshow(measured.picture, vmin=0, vmax=1)
    top = float(np.percentile(measured.rms_px, 98))
    x, y = measured.place.T
    shown = points.scatter(x, y, c=measured.rms_px, s=9, cmap="plasma", vmin=0, vmax=top)
    figure.colorbar(shown, ax=points, shrink=0.8, label=f"rms, px of {SIDE}")
    used, share = len(measured.place), len(measured.place) / measured.corners
    text = f"{used} points tracked of {measured.corners} corners ({share:.0%})"
    points.set(xticks=[], yticks=[], title=text)

    finite = np.isfinite(tilt.correlation)
    at_px = measured.distance_px[finite]
    distance.plot(at_px, tilt.correlation[finite], "o", ms=4, label="pairs of points")
    fit = measured.fitted_distance_px, tilt.fitted_correlation
    distance.plot(*fit, color="tab:orange", label="fit")
    distance.axhline(0.5, color="gray", lw=0.6)
    _mark_estimate(distance, found.tilt_correlation_half_length_px, "half length", "px")
    distance.set_xscale("symlog", linthresh=2)
    distance.set_xticks(DISTANCE_TICKS, map(str, DISTANCE_TICKS))
    distance.set(
        xlim=(-0.1, 1.45 * SIDE), ylim=(-0.3, 1.3), xlabel=f"distance, px of a frame of {SIDE}",
        ylabel="correlation of the tilt", title=describe_tracking_error(tilt.correlation[0]),
    )  # fmt: skip
    distance.legend(loc="lower left")

    lag.plot(np.arange(len(tilt.lag_correlation)) / (fps or 1), tilt.lag_correlation, "o-", ms=3)
    for level in (0, np.exp(-1)):
        lag.axhline(level, color="gray", lw=0.6)
    _mark_estimate(lag, found.tilt_correlation_time_s, "1/e", "s")
    text = f"1/e after {tilt.decay_frames:.1f} frames"
    if tilt.decay_frames > (longest := longest_decay_frames(measured.frames)):
        text = f"1/e after {longest:.0f} frames or more"
    unit = "lag, frames" if fps is None else "lag, s"
    lag.set(xlabel=unit, ylabel="correlation of the tilt", ylim=(-0.5, 1.05), title=text)
    figure.suptitle(title)
    return save_figure(figure, path)


def describe_tracking_error(correlation: float) -> str:
    """Return the title for the correlation of points at distance 0, over the fit's, which is 1:
    what it has more is the error of tracking; nothing where it is not more, or unknown."""
    excess = correlation - 1
    return f"tracking error: {excess:.2f} above the fit at distance 0" if excess > 0 else ""


def _mark_estimate(axes: Axes, estimate: IntervalEstimate, name: str, unit: str) -> None:
    """Mark a length or a time, and its interval, on the abscissa."""
    if (value := estimate.value) is not None:
        axes.axvline(value, color="tab:red", lw=1.2, label=f"{name} {value:.3g} {unit}")
    if estimate.low is not None and estimate.high is not None:
        axes.axvspan(estimate.low, estimate.high, color="tab:red", alpha=0.12, lw=0)
