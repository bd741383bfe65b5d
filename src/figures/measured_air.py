"""The picture of measured air: where it was measured, over distance, over time, in numbers."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from src.figures import plots
from src.recordings.calibration.air_meter import Air
from src.recordings.files.measured import SIDE, Estimate

NAMES = {
    "rms_px": "rms of the tilt, one axis, px",
    "half_length_px": "half length of the tilt, px",
    "whole_share": "share of the whole view",
    "decay_s": "time to 1/e, s",
    "blur_ratio": "edges, typical / sharpest tenth",
}


def air(air: Air, title: str, path: Path) -> Path:
    """Draw points coloured by rms on the mean frame, the tilt's correlation over distance and over
    lag, and the numbers with their intervals."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    where, distance, numbers, lag = figure.subplots(2, 2).flat
    _points(where, air)
    _distance(distance, air)
    _numbers(numbers, air)
    _lag(lag, air)
    figure.suptitle(title)
    return plots.save(figure, path)


def _points(axes: Axes, air: Air) -> None:
    axes.imshow(air.picture, cmap="gray", vmin=0, vmax=1)
    top = float(np.percentile(air.rms_px, 98))
    shown = axes.scatter(*air.place.T, c=air.rms_px, s=9, cmap="plasma", vmin=0, vmax=top)
    axes.figure.colorbar(shown, ax=axes, shrink=0.8, label=f"rms, px of {SIDE}")
    axes.set(xticks=[], yticks=[])
    used, share = len(air.place), len(air.place) / air.corners
    axes.set_title(f"{used} points followed of {air.corners} corners ({share:.0%})", fontsize=10)


def _distance(axes: Axes, air: Air) -> None:
    tilt, half = air.tilt, air.found.half_length_px
    finite = np.isfinite(tilt.correlation)
    axes.plot(air.distance_px[finite], tilt.correlation[finite], "o", ms=4, label="pairs of points")
    axes.plot(air.fitted_px, tilt.fitted, color="tab:orange", label="fit")
    axes.axhline(0.5, color="gray", lw=0.6)
    _mark(axes, half, "half length", "px")
    axes.set_xscale("symlog", linthresh=2)
    ticks = [0, 1, 2, 5, 10, 20, 50, 100, 200]
    axes.set_xticks(ticks, map(str, ticks))
    axes.set(xlim=(-0.1, 1.45 * SIDE), ylim=(-0.3, 1.3))
    axes.set(xlabel=f"distance, px of a frame of {SIDE}", ylabel="correlation of the tilt")
    axes.set_title("the excess at distance 0 is the error of following", fontsize=10)
    axes.legend(fontsize=8, loc="lower left")


def _lag(axes: Axes, air: Air) -> None:
    memory = air.tilt.memory
    lags = np.arange(len(memory))
    axes.plot(lags if air.fps is None else lags / air.fps, memory, "o-", ms=3)
    axes.axhline(np.exp(-1), color="gray", lw=0.6)
    axes.axhline(0, color="gray", lw=0.6)
    _mark(axes, air.found.decay_s, "1/e", "s")
    axes.set(xlabel="lag, frames" if air.fps is None else "lag, s", ylim=(-0.5, 1.05))
    axes.set(ylabel="correlation of the tilt")
    frames = air.tilt.decay
    within = f"1/e after {frames:.1f} frames" if np.isfinite(frames) else "1/e beyond the film"
    axes.set_title(within, fontsize=10)


def _mark(axes: Axes, one: Estimate, name: str, unit: str) -> None:
    """Mark a length or a time, and its interval, on the abscissa."""
    if one.value is not None:
        axes.axvline(one.value, color="tab:red", lw=1.2, label=f"{name} {one.value:.3g} {unit}")
    if one.low is not None and one.high is not None:
        axes.axvspan(one.low, one.high, color="tab:red", alpha=0.12, lw=0)


def _numbers(axes: Axes, air: Air) -> None:
    axes.set_axis_off()
    rate = "frame rate not known" if air.fps is None else f"{air.fps:g} frames a second"
    axes.set_title(f"{air.frames} frames, {rate}; value, interval of 95 %", fontsize=10)
    for row, (key, name) in enumerate(NAMES.items()):
        y = 0.85 - 0.16 * row
        axes.text(0.0, y, name, transform=axes.transAxes, fontsize=11)
        shown = str(getattr(air.found, key))
        axes.text(0.52, y, shown, transform=axes.transAxes, fontsize=11, family="monospace")
