"""What atmospheres the prior draws:

    python -m scripts.turbulence_prior [air.yaml ...] [--figure FILE]

Prints quantiles of the draws of each severity and of the clips of data=test_photos, and draws rms
tilt against its half length (out/turbulence_prior.png).  `air.yaml` files are those of `python -m
src.calibrate task=air`, shown with their intervals.
"""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from src.app import simulation
from src.app.compose import compose_config
from src.app.script import run_script
from src.figures.plots import save_figure
from src.records import safe_yaml
from src.sim.turbulence import Atmosphere, sample_atmosphere

COUNT, WIDTH = 400, 256
COLOURS = {  # ever darker
    "weak": "#f0b429", "medium": "#d1571b", "strong": "#1f5fa8", "extreme": "#2d1e5f"
}  # fmt: skip
FARTHEST = 2000.0  # px; what is longer is drawn there
COLUMNS = {
    "tilt, px": lambda path: path.tilt_std_px(WIDTH),
    "half length, px": lambda path: path.tilt_correlation_half_length_px(WIDTH),
    "tilt and blur, px": lambda path: path.tilt_and_blur_px(WIDTH),
    "D/r0": lambda path: path.d_over_r0,
    "lambda/D, px": lambda path: path.lambda_over_d_px(WIDTH),
    "D, px at the object": lambda path: path.aperture_m / path.pixel_size_at_object_m(WIDTH),
    "D / L0": lambda path: path.aperture_over_outer_scale,
    "Rytov": lambda path: path.rytov_variance,
}


def draw_atmospheres() -> dict[str, list[Atmosphere]]:
    """Return atmospheres of each severity and of their mix."""
    return {
        name: [sample_atmosphere(name, torch.Generator().manual_seed(k)) for k in range(COUNT)]
        for name in ("weak", "medium", "strong", "mixed")
    }


def draw_test_atmospheres() -> dict[str, list[Atmosphere]]:
    """Return the atmospheres of the clips of data=test_photos, by severity."""
    cfg = compose_config("eval", "data=test_photos", "paths.run=.")
    pipeline = simulation.build_pipeline(cfg, "test")
    paths = [pipeline.draw(number).turbulence for number in range(cfg.data.test_clips)]
    names = sorted({path.severity for path in paths}, key=list(COLOURS).index)
    return {f"test, {n}": [path for path in paths if path.severity == n] for n in names}


def format_table(found: Mapping[str, Sequence[Atmosphere]]) -> str:
    """Return the 10, 50 and 90 % quantiles of every column as Markdown."""
    lines = ["| 10 / 50 / 90 % | " + " | ".join(COLUMNS) + " |"]
    lines.append("|---" * (len(COLUMNS) + 1) + "|")
    for name, paths in found.items():
        cells = []
        for column in COLUMNS.values():
            values = np.percentile([column(path) for path in paths], [10, 50, 90])
            texts = (f"{value:.2g}" if value < 100 else f"{value:.0f}" for value in values)
            cells.append(" / ".join(texts))
        lines.append(f"| {name} ({len(paths)}) | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def plot_prior(
    found: Mapping[str, Sequence[Atmosphere]], measured: Sequence[Path], path: Path
) -> None:
    """Draw rms tilt against half length: draws as dots, footage as crosses with intervals."""
    figure = Figure(figsize=(8.4, 5), layout="constrained")
    axes = figure.subplots()
    for name in ("weak", "medium", "strong"):
        x = [min(each.tilt_correlation_half_length_px(WIDTH), FARTHEST) for each in found[name]]
        y = [each.tilt_std_px(WIDTH) for each in found[name]]
        axes.plot(x, y, ".", ms=4, alpha=0.6, color=COLOURS[name], label=name)
    lengths = [each.tilt_correlation_half_length_px(WIDTH) for each in found["mixed"]]
    x = np.percentile(lengths, [10, 90])
    y = np.percentile([each.tilt_std_px(WIDTH) for each in found["mixed"]], [10, 90])
    box = Rectangle((x[0], y[0]), *np.diff(x), *np.diff(y), fill=False, ls="--", lw=1.2)
    box.set_label("central 80 % of mixed")
    axes.add_patch(box)
    for file, marker in zip(measured, "X*PDv^s", strict=False):
        air = safe_yaml.read(file)
        at = [air[key]["value"] for key in ("tilt_correlation_half_length_px", "tilt_rms_px")]
        ends = [air[key]["interval"] for key in ("tilt_correlation_half_length_px", "tilt_rms_px")]
        error = [
            np.abs(np.array(end) - value)[:, None] for value, end in zip(at, ends, strict=True)
        ]
        axes.errorbar(*at, xerr=error[0], yerr=error[1], fmt=marker, color="black", ms=9, capsize=3,
                      label=f"footage: {file.parent.name}")  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel="half length of the tilt, px of a frame 256 wide",
             ylabel="rms tilt per axis, px")  # fmt: skip
    axes.grid(alpha=0.3)
    figure.legend(fontsize=8, loc="outside right upper")
    save_figure(figure, path)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("measured", type=Path, nargs="*", help="files of task=air")
    parser.add_argument("--figure", type=Path, default=Path("out/turbulence_prior.png"))
    given = parser.parse_args()
    atmospheres = draw_atmospheres()
    print(format_table(atmospheres | draw_test_atmospheres()))
    plot_prior(atmospheres, given.measured, given.figure)


if __name__ == "__main__":
    run_script(main)
