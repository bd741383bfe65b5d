"""Event rate against contrast threshold, with the recording's band (the paper's supplement)."""

from pathlib import Path

from matplotlib.figure import Figure

from src.recordings.calibration.contrast import Estimate

COLOURS = ("tab:blue", "tab:red")
TICKS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)


def threshold(found: Estimate, path: Path) -> None:
    """Draw the simulated rates, the recording's with their intervals, and where they meet."""
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    ratio = found.curve.off_ratio
    for side, (name, colour) in enumerate(zip(("ON", "OFF"), COLOURS, strict=True)):
        at = found.curve.thresholds * (ratio if side else 1.0)
        axes.loglog(at, found.curve.rates[:, side], color=colour, label=f"simulated {name}")
        axes.axhspan(*found.interval[:, side], color=colour, alpha=0.2)
        axes.axhline(found.rates[side], color=colour, lw=0.8, ls="--", label=f"recording {name}")
        value, low, high = found.off if side else found.on
        text = f"{name}: C = {value:.3f} ({low:.3f} to {high:.3f})"
        axes.errorbar(
            value, found.rates[side], xerr=[[max(value - low, 0)], [max(high - value, 0)]],
            color=colour, marker="o", capsize=4, label=text,
        )  # fmt: skip
    axes.set(xlabel="contrast threshold C (nat)", ylabel="events / pixel / s")
    axes.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=150)
