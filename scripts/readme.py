"""The README's picture, and shipped weights measured: python -m scripts.readme --root PHOTOS.

Made anew: docs/figures/nine_views.png, and the section between the README's marks `report:results`,
scores of test clips of the photographs in PHOTOS (data=test_photos), each simulated once for all
networks, beside the published ones whose weights are in `--published`.  Without PHOTOS only the
picture.  The same for docs/results.md of data=test_footage, with `--footage`, a still scene through
air, and, what differs, of sensors with random faults (sensor=randomized).  The cards are given
the scores, too, and those of data=test_targets.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from src import models
from src.app import build
from src.app.compose import compose_config
from src.app.instantiate import build_part
from src.bench.candidates import Candidate
from src.figures import plots
from src.metrics.bootstrap import bootstrap_interval
from src.metrics.table import METRICS, Column
from src.models import files
from src.records import results
from src.reports.writers import replace_section
from src.sim.optics import layout
from src.sim.pipeline import Sample, simulate

HOME = Path(__file__).resolve().parents[1]
ONE, NINE = ("setnet_small", 1), ("setnet_small", 9)  # of the picture
# Local air, whose parts of a view are displaced apart.
AIR = ("turbulence=strong", "turbulence.atmosphere.tilt_correlation_half_length_px=[10,20]",
       "turbulence.atmosphere.global_tilt_probability=0.0")  # fmt: skip
PAPER = "nine views, E2VID (the paper's method)"
LARGE, MEDIUM = "nine views, SetNet large", "nine views, SetNet medium"
SMALL, SINGLE = "nine views, SetNet small", "one view, SetNet medium"
ROWS = {  # what it is: a network in weights/, how many of the nine views it is given
    LARGE: ("setnet_large", 9),
    MEDIUM: ("setnet_medium", 9),
    SMALL: ("setnet_small", 9),
    PAPER: ("lf3x3", 9),
    SINGLE: ("setnet_medium", 1),
    "one view, E2VID": ("single256", 1),
    "one view, E2VID+ trained without turbulence": ("clean/e2vid_plus", 1),
}
BASELINES = {  # their files in the folder of published weights
    "firenet_plus": ["FireNet+/firenet_plus_state_dict.pth"],
    "cista": ["CISTA-TC/cista-tc.pth.tar"],
    "pienet": ["PIE-Net/model.pth"],
    "pienet_lite": ["PIE-Net/model_lite.pth"],
    "highpass": [],
}
OTHERS = {
    "one view, published FireNet+": ("firenet_plus", 1),
    "one view, published CISTA-TC": ("cista", 1),
    "one view, published PIE-Net": ("pienet", 1),
    "one view, published PIE-Net-Lite": ("pienet_lite", 1),
}
VIEWS = {  # differences, clip by clip: of nine views and one
    "Δ (9 − 1 views), E2VID": (PAPER, "one view, E2VID"),
    "Δ (9 − 1 views), SetNet medium": (MEDIUM, SINGLE),
}
BEST = {"Δ nine views, SetNet medium − E2VID": (MEDIUM, PAPER)}
NETWORKS = BEST | {  # of networks
    "Δ nine views, SetNet small − E2VID": (SMALL, PAPER),
    "Δ nine views, SetNet large − medium": (LARGE, MEDIUM),
}
TABLES = {  # of what is measured: document, section, whether scores are in it, differences
    "data=test_photos": (
        ("README.md", "results", True, VIEWS),
        ("docs/results.md", "differences", False, NETWORKS),
    ),
    "data=test_footage": (("docs/results.md", "footage", False, VIEWS | BEST),),
    "data=test_photos sensor=randomized": (("docs/results.md", "drawn", False, VIEWS | BEST),),
}


def baseline_overrides(name: str, published: Path | None) -> list[str]:
    """Return the overrides that choose one of BASELINES, its weights in the folder `published`."""
    weights = [f"baseline.weights={published}/{file}" for file in BASELINES[name]]
    return [f"baseline={name}", *weights]


def load_shipped(name: str, views: int, published: Path | None = None) -> Candidate:
    """Return a shipped network, or one of BASELINES with its weights in the folder `published`."""
    if name not in BASELINES:
        return Candidate(name, models.load(name), views)
    cfg = compose_config("eval", *baseline_overrides(name, published))
    return Candidate(name, build_part(cfg, "baseline").eval(), views)


def reconstruct_clip(network: Candidate, sample: Sample) -> Tensor:
    """Return the frames (windows, 1, h, w) that a network makes of `sample`, a single clip."""
    positions = list(sample.positions or layout(sample.voxels.shape[2]))
    return network.reconstruct(sample.voxels[0, :, None], positions, float(sample.window_s[0]))[0]


def score_clips_into_metrics(
    cfg: DictConfig, rows: dict[str, Candidate]
) -> dict[str, list[dict[str, float]]]:
    """Return the scores of all `rows` on each of the test clips of `cfg`."""
    pipeline, measure = build.build_pipeline(cfg, "test"), build.build_metrics(cfg)
    values, clips = {row: [] for row in rows}, cfg.data.test_clips
    for clip in range(clips):
        sample = simulate(pipeline, [clip])
        for row, network in rows.items():
            frames = reconstruct_clip(network, sample)[cfg.data.unscored_windows :]
            values[row].append(measure(frames, sample.target[0, cfg.data.unscored_windows :]))
        print(f"{clip + 1} of {clips} clips", flush=True)
    return values


def format_table(
    values: dict[str, list[dict[str, float]]], rows: bool, pairs: dict[str, tuple[str, str]]
) -> str:
    """Return the scores of `values` as Markdown, where `rows` says so, and differences of pairs."""
    heads = [metric.title for metric in METRICS]
    lines = ["| | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    for row, clips in values.items() if rows else ():
        lines.append(f"| {row} | " + " | ".join(format_means(clips)) + " |")
    for name, (first, second) in pairs.items():
        if {first, second} <= set(values):
            cells = format_differences(values[first], values[second])
            lines.append(f"| *{name}* | " + " | ".join(cells) + " |")
    note = "mean (95 % bootstrap CI); Δ: paired differences."
    return "\n".join([*lines, "", f"{len(next(iter(values.values())))} clips; {note}"])


def format_means(clips: list[dict[str, float]]) -> list[str]:
    """Return the scores of clips, per metric."""
    return [format_mean(m, [clip[m.name] for clip in clips]) for m in METRICS]


def format_differences(first: list[dict[str, float]], second: list[dict[str, float]]) -> list[str]:
    """Return by how much the scores of the same clips differ, per metric."""
    pairs = list(zip(first, second, strict=True))
    return [format_mean(m, [a[m.name] - b[m.name] for a, b in pairs], "+") for m in METRICS]


def format_mean(metric: Column, values: list[float], sign: str = "") -> str:
    """Return the mean and its interval."""
    form, (low, high) = f"{sign}.{metric.digits}f", bootstrap_interval(values)
    return f"{np.mean(values):{form}} ({low:{form}} to {high:{form}})"


def update_card(card: Path, protocol: str, commit: str, clips: list[dict[str, float]]) -> None:
    """Put the scores of `clips` on a card, in the place of what was there of their protocol."""
    start, lines = f"| `{protocol}`", card.read_text().splitlines()
    what = f"{start}, by scripts.readme, at {commit} | {len(clips)} | "
    row = what + " | ".join(format_means(clips)) + " |"
    place = next(n for n, line in enumerate(lines) if line.startswith((start, "In brackets")))
    if lines[place].startswith(start):
        lines[place] = row
    else:  # at the end of the table, a blank line before what is said of its brackets
        lines.insert(place - 1, row)
    results.write_text(card, "\n".join(lines) + "\n")


def draw_figure(path: Path, index: int, windows: int) -> None:
    """Draw a clip through strong local air: the last frame and the x-t slice of its middle row."""
    cfg = compose_config("simulate", *AIR, "fps=120", "scene.height=192", "scene.width=192",
                 "sensor.threshold=0.15", f"data.test_windows={windows}")  # fmt: skip
    sample = simulate(build.build_pipeline(cfg, "test"), [index])
    panels = {
        "what one view sees": sample.turbulent[0],
        "one view, reconstructed": reconstruct_clip(load_shipped(*ONE), sample),
        "nine views, reconstructed": reconstruct_clip(load_shipped(*NINE), sample),
        "ground truth": sample.target[0],
    }
    figure = Figure(figsize=(10, 4.1), layout="constrained")
    grid = figure.subplots(2, len(panels), height_ratios=(3, 1))
    for (name, video), (above, below) in zip(panels.items(), grid.T, strict=True):
        film = video[:, 0].numpy()
        middle = film.shape[1] // 2
        above.imshow(film[-1], cmap="gray", vmin=0, vmax=1)
        above.axhline(middle, color="gold", linewidth=0.8)
        above.set_title(name, fontsize=10)
        below.imshow(film[:, middle], cmap="gray", vmin=0, vmax=1, aspect="auto")
        for axes in (above, below):
            axes.set(xticks=[], yticks=[])
    grid[1, 0].set_ylabel("time, down", fontsize=8)
    plots.save_figure(figure, path)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder of photographs that no network was trained on")
    parser.add_argument("--footage", help="a video or folder of frames: a still scene through air")
    parser.add_argument("--published", type=Path, help="a folder of published weights")
    parser.add_argument("--index", type=int, default=0, help="the clip of the picture")
    given = parser.parse_args()
    if given.footage and not given.root:
        parser.error("--footage needs --root, the photographs that it moves")
    commit = results.git_commit()  # before anything is written
    draw_figure(HOME / "docs" / "figures" / "nine_views.png", given.index, 40)
    if not given.root:
        return
    photos = [f"scene.root={given.root}"]
    asked = {
        "data=test_photos": photos,
        "data=test_photos sensor=randomized": photos,
        "data=test_targets": [],
    }
    if given.footage:
        asked["data=test_footage"] = [f"turbulence.root={given.footage}", *photos]
    chosen = ROWS | (OTHERS if given.published else {})
    rows = {row: load_shipped(*what, given.published) for row, what in chosen.items()}
    cards = {name: row for row, (name, _) in reversed(ROWS.items())}  # the row of most views
    for protocol, overrides in asked.items():
        values = score_clips_into_metrics(
            compose_config("eval", *protocol.split(), *overrides), rows
        )
        for document, section, whole, pairs in TABLES.get(protocol, ()):
            replace_section(HOME / document, section, format_table(values, whole, pairs))
        for name, row in cards.items():
            update_card(files.WEIGHTS / f"{name}.md", protocol, commit, values[row])


if __name__ == "__main__":
    main()
