"""Event rate against contrast threshold, with the recording's band (the paper's supplement)."""

from pathlib import Path

from matplotlib.figure import Figure

from src.figures import plots
from src.recordings.calibration.contrast_threshold import Estimate

COLOURS = ("tab:blue", "tab:red")
TICKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)


def threshold(estimate: Estimate, path: Path) -> None:
    """Draw the simulated rates, the recording's with their intervals, and where they meet."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    ratio = estimate.curve.off_ratio
    for side, (name, colour) in enumerate(zip(("ON", "OFF"), COLOURS, strict=True)):
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
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    plots.save(figure, path)
