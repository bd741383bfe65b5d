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


def air(found: Air, title: str, path: Path) -> Path:
    """Draw points coloured by rms on the mean frame, the tilt's correlation over distance and over
    lag, and the numbers with their intervals."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    where, distance, numbers, lag = figure.subplots(2, 2).flat
    _points(where, found)
    _distance(distance, found)
    _numbers(numbers, found)
    _lag(lag, found)
    figure.suptitle(title)
    return plots.save(figure, path)


def _points(axes: Axes, found: Air) -> None:
    axes.imshow(found.picture, cmap="gray", vmin=0, vmax=1)
    top = float(np.percentile(found.rms_px, 98))
    shown = axes.scatter(*found.place.T, c=found.rms_px, s=9, cmap="plasma", vmin=0, vmax=top)
    axes.figure.colorbar(shown, ax=axes, shrink=0.8, label=f"rms, px of {SIDE}")
    axes.set(xticks=[], yticks=[])
    used, share = len(found.place), len(found.place) / found.corners
    axes.set_title(f"{used} points followed of {found.corners} corners ({share:.0%})", fontsize=10)


def _distance(axes: Axes, found: Air) -> None:
    tilt, half = found.tilt, found.found.half_length_px
    known = np.isfinite(tilt.correlation)
    axes.plot(found.distance_px[known], tilt.correlation[known], "o", ms=4, label="pairs of points")
    axes.plot(found.fitted_px, tilt.fitted, color="tab:orange", label="fit")
    axes.axhline(0.5, color="gray", lw=0.6)
    _mark(axes, half, "half length", "px")
    axes.set_xscale("symlog", linthresh=2)
    axes.set_xticks(
        [0, 1, 2, 5, 10, 20, 50, 100, 200], ["0", "1", "2", "5", "10", "20", "50", "100", "200"]
    )
    axes.set(xlim=(-0.1, 1.45 * SIDE), ylim=(-0.3, 1.3))
    axes.set(xlabel=f"distance, px of a frame of {SIDE}", ylabel="correlation of the tilt")
    axes.set_title("the excess at distance 0 is the error of following", fontsize=10)
    axes.legend(fontsize=8, loc="lower left")


def _lag(axes: Axes, found: Air) -> None:
    memory = found.tilt.memory
    lags = np.arange(len(memory))
    axes.plot(lags if found.fps is None else lags / found.fps, memory, "o-", ms=3)
    axes.axhline(np.exp(-1), color="gray", lw=0.6)
    axes.axhline(0, color="gray", lw=0.6)
    _mark(axes, found.found.decay_s, "1/e", "s")
    axes.set(xlabel="lag, frames" if found.fps is None else "lag, s", ylim=(-0.5, 1.05))
    axes.set(ylabel="correlation of the tilt")
    frames = found.tilt.decay
    within = f"1/e after {frames:.1f} frames" if np.isfinite(frames) else "1/e beyond the film"
    axes.set_title(within, fontsize=10)


def _mark(axes: Axes, one: Estimate, name: str, unit: str) -> None:
    """Mark a length or a time, and its interval, on the abscissa."""
    if one.value is not None:
        axes.axvline(one.value, color="tab:red", lw=1.2, label=f"{name} {one.value:.3g} {unit}")
    if one.low is not None and one.high is not None:
        axes.axvspan(one.low, one.high, color="tab:red", alpha=0.12, lw=0)


def _numbers(axes: Axes, found: Air) -> None:
    axes.set_axis_off()
    rate = "frame rate not known" if found.fps is None else f"{found.fps:g} frames a second"
    axes.set_title(f"{found.frames} frames, {rate}; value, interval of 95 %", fontsize=10)
    for row, (key, name) in enumerate(NAMES.items()):
        y = 0.85 - 0.16 * row
        axes.text(0.0, y, name, transform=axes.transAxes, fontsize=11)
        shown = str(getattr(found.found, key))
        axes.text(0.52, y, shown, transform=axes.transAxes, fontsize=11, family="monospace")
