"""The README's film, and shipped weights measured: python -m scripts.readme --root PHOTOS.

Made anew: docs/figures/nine_views.webp, and the sections between the marks `report:...` of README,
docs/tables.md and docs/results.md: scores of test clips of the photographs in PHOTOS
(data=test_photos), each simulated once for all networks, beside the published ones whose weights
are in `--published`, without which their rows stay as they are and the note says so; of
data=test_footage, with `--footage`, a still scene through air; of sensors with random faults
(sensor=randomized); and, with `--published`, without turbulence (turbulence=none).  Without PHOTOS
only the film.  The cards are given the scores, too, and those of data=test_targets.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from scripts.ship_weights import CARD_NOTE
from src.app import simulation
from src.app.compose import compose_config
from src.app.instantiate import build_part
from src.app.metrics import build_metrics
from src.app.script import run_script
from src.bench.candidates import Candidate
from src.figures import samples
from src.metrics.bootstrap import bootstrap_interval
from src.metrics.table import METRICS, Column
from src.models import files
from src.records import results
from src.records.atomic import write_text
from src.reports.writers import replace_section
from src.sim.optics import layout
from src.sim.pipeline import Sample, simulate

HOME = Path(__file__).resolve().parents[1]
ONE, NINE = ("setnet_medium", 1), ("setnet_medium", 9)  # of the film
WINDOWS = 72
# Local air, whose parts of a view are displaced apart.
AIR = ("turbulence=strong", "turbulence.atmosphere.tilt_correlation_half_length_px=[10,20]",
       "turbulence.atmosphere.global_tilt_probability=0.0")  # fmt: skip
PAPER, ONE_VIEW = "nine views, E2VID", "one view, E2VID"
LARGE, MEDIUM = "nine views, SetNet large", "nine views, SetNet medium"
SMALL, SINGLE = "nine views, SetNet small", "one view, SetNet medium"
E2VID_PLUS = "one view, E2VID+, no turbulence, 1.1 h"
HYPERE2VID = "one view, HyperE2VID, no turbulence, 1.1 h"
ETNET = "one view, ET-Net, no turbulence, 1.1 h"
CLEAN = {  # trained without turbulence: a network in weights/, how many views it is given
    E2VID_PLUS: ("clean/e2vid_plus", 1),
    HYPERE2VID: ("clean/hypere2vid", 1),
    ETNET: ("clean/etnet", 1),
}
ROWS = {  # what it is: as in CLEAN, of nine views
    LARGE: ("setnet_large", 9),
    MEDIUM: ("setnet_medium", 9),
    SMALL: ("setnet_small", 9),
    PAPER: ("lf3x3", 9),
    SINGLE: ("setnet_medium", 1),
    ONE_VIEW: ("single256", 1),
    E2VID_PLUS: CLEAN[E2VID_PLUS],
}
BASELINES = {  # their files in the folder of published weights
    "firenet_plus": ["FireNet+/firenet_plus_state_dict.pth"],
    "cista": ["CISTA-TC/cista-tc.pth.tar"],
    "pienet": ["PIE-Net/model.pth"],
    "pienet_lite": ["PIE-Net/model_lite.pth"],
    "highpass": [],
}
FIRENET, CISTA = "one view, published FireNet+", "one view, published CISTA-TC"
PIENET = "one view, published PIE-Net"
OTHERS = {
    FIRENET: ("firenet_plus", 1),
    CISTA: ("cista", 1),
    PIENET: ("pienet", 1),
    "one view, published PIE-Net-Lite": ("pienet_lite", 1),
}
OURS = (LARGE, MEDIUM, SMALL, PAPER, SINGLE, ONE_VIEW)
HEADLINE = (*OURS, CISTA, PIENET, FIRENET)  # rows of the README
SCORES = ("lpips", "ssim", "psnr_aligned")  # its columns
VIEWS = {  # differences, clip by clip: of nine views and one
    "Δ (9 − 1 views), E2VID": (PAPER, ONE_VIEW),
    "Δ (9 − 1 views), SetNet medium": (MEDIUM, SINGLE),
}
MEDIUM_AGAINST_ONE_VIEW = {"Δ SetNet medium, nine views − E2VID, one view": (MEDIUM, ONE_VIEW)}
BEST = {"Δ nine views, SetNet medium − E2VID": (MEDIUM, PAPER)}
AGAINST_FIRENET = {  # clip by clip
    "Δ E2VID+ − published FireNet+": (E2VID_PLUS, FIRENET),
    "Δ HyperE2VID − published FireNet+": (HYPERE2VID, FIRENET),
    "Δ ET-Net − published FireNet+": (ETNET, FIRENET),
}
NETWORKS = BEST | {  # of networks
    "Δ nine views, SetNet small − E2VID": (SMALL, PAPER),
    "Δ nine views, SetNet large − medium": (LARGE, MEDIUM),
}


class Table(NamedTuple):
    """A section of a document: rows whose scores are in it, differences, columns."""

    document: str
    section: str
    rows: tuple[str, ...]
    pairs: dict[str, tuple[str, str]]
    metrics: tuple[str, ...] = tuple(metric.name for metric in METRICS)

    @property
    def all_rows(self) -> set[str]:
        """The rows and those that differences are of."""
        return {*self.rows, *(row for pair in self.pairs.values() for row in pair)}


TABLES = {  # of what is measured
    "data=test_photos": (
        Table("README.md", "results", HEADLINE, {}, SCORES),
        Table(
            "docs/tables.md", "photos", (*(ROWS | CLEAN), *OTHERS), VIEWS | MEDIUM_AGAINST_ONE_VIEW
        ),
        Table("docs/results.md", "differences", (), NETWORKS),
    ),
    "data=test_photos turbulence=none": (
        Table("docs/tables.md", "clean", (*CLEAN, FIRENET), AGAINST_FIRENET),
    ),
    "data=test_footage": (
        Table("docs/tables.md", "footage", tuple(ROWS), MEDIUM_AGAINST_ONE_VIEW),
        Table("docs/results.md", "footage", (), VIEWS | BEST),
    ),
    "data=test_photos sensor=randomized": (
        Table("docs/tables.md", "drawn", tuple(ROWS), {}),
        Table("docs/results.md", "drawn", (), VIEWS | BEST),
    ),
    "data=test_targets": (Table("docs/tables.md", "targets", tuple(ROWS), VIEWS),),
}


def baseline_overrides(name: str, published: Path | None) -> list[str]:
    """Return the overrides that choose one of BASELINES, its weights in the folder `published`."""
    weights = [f"baseline.weights={published}/{file}" for file in BASELINES[name]]
    return [f"baseline={name}", *weights]


def load_shipped(name: str, views: int, published: Path | None = None) -> Candidate:
    """Return a shipped network, or one of BASELINES with its weights in the folder `published`."""
    if name not in BASELINES:
        return Candidate(name, files.load(name), views)
    cfg = compose_config("eval", *baseline_overrides(name, published))
    return Candidate(name, build_part(cfg, "baseline").eval(), views)


def reconstruct_clip(network: Candidate, sample: Sample) -> Tensor:
    """Return the frames (windows, 1, h, w) that a network makes of `sample`, a single clip."""
    positions = list(sample.positions or layout(sample.voxels.shape[2]))
    return network.reconstruct(sample.voxels[0, :, None], positions, float(sample.window_s[0]))[0]


def score_clips(cfg: DictConfig, rows: dict[str, Candidate]) -> dict[str, list[dict]]:
    """Return the scores of all `rows` on each of the test clips of `cfg`, and what a clip shows
    (`source`)."""
    pipeline, measure = simulation.build_pipeline(cfg, "test"), build_metrics(cfg)
    values, clips = {row: [] for row in rows}, cfg.data.test_clips
    for clip in range(clips):
        sample = simulate(pipeline, [clip])
        for row, network in rows.items():
            frames = reconstruct_clip(network, sample)[cfg.data.unscored_windows :]
            scores = measure(frames, sample.target[0, cfg.data.unscored_windows :])
            values[row].append({"source": sample.parameters[0]["source"], **scores})
        print(f"{clip + 1} of {clips} clips", flush=True)
    return values


def format_table(values: dict[str, list[dict]], table: Table, before: str = "") -> str:
    """Return what `table` says of the scores `values` as Markdown, without rows not in them but for
    those of published networks in the document as it was `before`, which the note says.
    """
    earlier, kept = "", {line.split(" | ")[0].strip("| "): line for line in before.splitlines()}
    columns = [metric for metric in METRICS if metric.name in table.metrics]
    heads = [metric.title for metric in columns]
    lines = ["| | " + " | ".join(heads) + " |", "|---|" + "---|" * len(heads)]
    for row in table.rows:
        if row in values:
            lines.append(f"| {row} | " + " | ".join(format_means(values[row], columns)) + " |")
        elif row in OTHERS and row in kept:
            lines.append(kept[row])
            earlier = " Published networks: measured before."
    for name, (first, second) in table.pairs.items():
        if {first, second} <= set(values):
            gains = list(map(subtract_scores, values[first], values[second]))
            cells = format_means(gains, columns, "+")
            lines.append(f"| *{name}* | " + " | ".join(cells) + " |")
    paired = "; Δ: paired differences" if table.pairs else ""
    clips = len(next(iter(values.values())))
    return "\n".join([*lines, "", f"{clips} clips; mean (95 % bootstrap CI){paired}.{earlier}"])


def subtract_scores(ours: dict, theirs: dict) -> dict:
    """Return the differences of the scores of a clip, None where one has none."""
    pairs = {m.name: (ours.get(m.name), theirs.get(m.name)) for m in METRICS}
    gains = {name: None if None in pair else pair[0] - pair[1] for name, pair in pairs.items()}
    return {"source": ours.get("source"), **gains}


def format_means(
    clips: list[dict], columns: Sequence[Column] = METRICS, sign: str = ""
) -> list[str]:
    """Return the mean of each metric over the clips that have one, with its interval."""
    return [format_mean(m, [clip for clip in clips if clip[m.name] is not None], sign)
            for m in columns]  # fmt: skip


def format_mean(metric: Column, clips: list[dict], sign: str) -> str:
    values, form = [clip[metric.name] for clip in clips], f"{sign}.{metric.digits}f"
    low, high = bootstrap_interval(values, groups=results.list_sources(clips))
    interval = "" if np.isnan(low) else f" ({low:{form}} to {high:{form}})"
    return f"{np.mean(values):{form}}{interval}"


def update_card(card: Path, protocol: str, commit: str, clips: list[dict]) -> None:
    """Put the scores of `clips` on a card, in the place of what was there of their protocol."""
    start, lines = f"| `{protocol}`", card.read_text().splitlines()
    what = f"{start}, by scripts.readme, at {commit} | {len(clips)} | "
    row = what + " | ".join(format_means(clips)) + " |"
    place = next(n for n, line in enumerate(lines) if line.startswith((start, CARD_NOTE)))
    if lines[place].startswith(start):
        lines[place] = row
    else:  # at the end of the table, a blank line before its note
        lines.insert(place - 1, row)
    write_text(card, "\n".join(lines) + "\n")


def write_film(path: Path, index: int) -> None:
    """Write a film of a clip through strong local turbulence, below each panel the x-t slice of its
    middle row so far."""
    cfg = compose_config("simulate", *AIR, "fps=120", "scene.height=192", "scene.width=192",
                 "sensor.threshold=0.15", f"data.test_windows={WINDOWS}")  # fmt: skip
    pipeline = simulation.build_pipeline(cfg, "test")
    sample = simulate(pipeline, [index])
    counts = sample.voxels[0, :, pipeline.optics.centre].sum(1).numpy()
    one, nine = (reconstruct_clip(load_shipped(*what), sample) for what in (ONE, NINE))
    panels = {
        "events of the centre view": samples.render_events(counts),
        "one view": one[:, 0].numpy(),
        "nine views": nine[:, 0].numpy(),
        "ground truth": sample.target[0, :, 0].numpy(),
    }
    film = samples.join_panels({name: append_slice(video) for name, video in panels.items()})
    samples.write_animation(path, film, samples.PLAYBACK_FPS)


def append_slice(
    video: Float[np.ndarray, "frames h w *rgb"],
) -> Float[np.ndarray, "frames hslice w *rgb"]:
    """Return the video with the x-t slice of its middle row below, in each frame as far as time has
    come, the rest white."""
    frames, height, width, *rgb = video.shape
    slices = np.ones((frames, frames, width, *rgb), video.dtype)
    for frame in range(frames):
        slices[frame, : frame + 1] = video[: frame + 1, height // 2]
    gap = np.ones((frames, samples.GAP_PX, width, *rgb), video.dtype)
    return np.concatenate([video, gap, slices], axis=1)


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", help="a folder of photographs that no network was trained on")
    parser.add_argument("--footage", help="a video or folder of frames: a still scene through air")
    parser.add_argument("--published", type=Path, help="a folder of published weights")
    parser.add_argument("--index", type=int, default=0, help="the clip of the film")
    given = parser.parse_args()
    if given.footage and not given.root:
        parser.error("--footage needs --root, the photographs that it moves")
    commit = results.git_commit()  # before anything is written
    write_film(HOME / "docs" / "figures" / "nine_views.webp", given.index)
    if not given.root:
        return
    photos = [f"scene.root={given.root}"]
    asked = {
        "data=test_photos": photos,
        "data=test_photos sensor=randomized": photos,
        "data=test_targets": [],
    }
    if given.published:  # whose differences to them are the table
        asked["data=test_photos turbulence=none"] = photos
    if given.footage:
        asked["data=test_footage"] = [f"turbulence.footage={given.footage}", *photos]
    chosen = ROWS | CLEAN | (OTHERS if given.published else {})
    rows = {row: load_shipped(*what, given.published) for row, what in chosen.items()}
    cards = {name: row for row, (name, _) in reversed((ROWS | CLEAN).items())}  # of most views
    for protocol, overrides in asked.items():
        shown = {row for table in TABLES[protocol] for row in table.all_rows}
        values = score_clips(
            compose_config("eval", *protocol.split(), *overrides),
            {row: network for row, network in rows.items() if row in shown},
        )
        for table in TABLES[protocol]:
            document = HOME / table.document
            text = format_table(values, table, document.read_text())
            replace_section(document, table.section, text)
        for name, row in cards.items():
            if row in values:
                update_card(files.WEIGHTS / f"{name}.md", protocol, commit, values[row])


if __name__ == "__main__":
    run_script(main)
