"""The record of a run: its folder, the resolved config, `results.json`, `clips.csv`, the table."""

import csv
import hashlib
import io
import json
import math
import os
import re
import shutil
import statistics
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rich
from rich import box
from rich.console import RenderableType
from rich.table import Table

from src.metrics.bootstrap import bootstrap_difference_interval, bootstrap_interval
from src.metrics.table import METRICS, NAMES, Column
from src.records import safe_yaml
from src.records.atomic import partial_path, write_text

SCHEMA = 1
CONFIG_FILE = "config.yaml"
RUN_FREE_BYTES = 200 * 2**20  # that the disk of a new run must have free


@dataclass(frozen=True)
class ScoreRow:
    """A network of a table: scores and drawn parameters of every clip, and its cost; times by frame
    size, such as 128x128; `own_metrics`: those of the scores that a config has added.
    """

    name: str
    clips: list[dict]
    params: int
    macs_per_frame: int
    latency_ms_by_size: dict[str, float]
    own_metrics: tuple[Column, ...] = ()


@contextmanager
def store_config_when_done(run: Path, config: str) -> Iterator[None]:
    """As `create_run_folder`, but until the block has ended the config is `config.partial.yaml`.

    What an earlier run left there keeps its own config where the block fails.  Where it raises
    ValueError with no file written, a refusal, no config is left.
    """
    whole = run / CONFIG_FILE
    partial = partial_path(whole)
    create_run_folder(run, config, partial.name)
    before = _modification_times(run)
    try:
        yield
    except ValueError:
        if _modification_times(run) == before:
            partial.unlink()
        raise
    os.replace(partial, whole)


def _modification_times(run: Path) -> dict[str, int]:
    """Return {name: nanoseconds} of what lies in a run's folder, but for hidden files."""
    found = (file for file in run.iterdir() if not file.name.startswith("."))
    return {file.name: file.stat().st_mtime_ns for file in found}


def create_run_folder(run: Path, config: str, name: str = CONFIG_FILE) -> None:
    """Create the folder `run` and store the resolved `config` (YAML) in it, as `name`.

    Raises ValueError where the folder cannot be made, holds results of another config, or the disk
    is nearly full.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"paths.out must be a folder to write to, got {run}: {error}") from error
    free = shutil.disk_usage(run).free
    if free < RUN_FREE_BYTES:
        needed, got = RUN_FREE_BYTES >> 20, free >> 20
        raise ValueError(f"paths.out must have {needed} MiB free, got {got} MiB at {run}")
    has_results(run, config)
    write_text(run / name, config)


def parse_settings_without_paths(config: str) -> dict:
    """Return the settings of a resolved `config` (YAML) that the numbers depend on: all but
    `paths` and, for training, the `ckpt` that it goes on from, which its results state."""
    settings = safe_yaml.parse(config)
    settings.pop("verbose", None)  # of versions up to 0.6.12: it printed the config
    run = settings.pop("paths", {}).get("run")
    if settings.get("task") == "train":
        settings.pop("ckpt", None)
    text = json.dumps(settings)
    return json.loads(text.replace(json.dumps(run)[1:-1], "RUN")) if run else settings


def hash_config(config: str) -> str:
    """Return the SHA-256 of `parse_settings_without_paths(config)`: the same in every folder."""
    settings = json.dumps(parse_settings_without_paths(config), sort_keys=True)
    return hashlib.sha256(settings.encode()).hexdigest()


def has_results(run: Path, config: str) -> bool:
    """Return whether `run` holds the results of `config`.

    Raises ValueError where it holds those of another config: no result is overwritten.
    """
    file = run / "results.json"
    if not file.is_file():
        return False
    if json.loads(file.read_text()).get("config_sha256") != hash_config(config):
        keys = "hydra.run.dir, or paths.out of a sweep,"
        raise ValueError(f"{keys} must be another folder: {run} holds results of another config")
    return True


def summarize_scores(clips: list[dict], own_metrics: Iterable[Column] = ()) -> dict:
    """Return {clips, metric: {mean, std, interval}} over clips; `interval`: 95 % bootstrap CI.

    `std`: standard deviation of the clips' values.  Clips that state their number of `frames`, as
    recorded sequences do, count by it in all three; clips without a score (None) are left out.
    The interval, None of clips of one photograph or video, is over photographs (`list_sources`).
    """
    summary: dict = {"clips": len(clips)}
    for metric in (*NAMES, *(metric.name for metric in own_metrics)):
        scored = [clip for clip in clips if clip.get(metric) is not None]
        if not scored:
            continue
        values, weights = [clip[metric] for clip in scored], frame_weights(scored)
        mean, std = statistics.fmean(values, weights), _weighted_std(values, weights)
        interval = bootstrap_interval(values, weights, list_sources(scored))
        known = None if math.isnan(interval[0]) else interval
        summary[metric] = {"mean": mean, "std": std, "interval": known}
    return summary


def _weighted_std(values: list[float], weights: list[float] | None) -> float:
    """Return the population standard deviation; weights None: all alike, as `np.std`."""
    deviations = np.asarray(values) - np.average(values, weights=weights)
    return float(np.sqrt(np.average(deviations**2, weights=weights)))


def frame_weights(clips: list[dict]) -> list[float] | None:
    """Return the number of frames of each clip where all state it, None: they count alike."""
    return [float(clip["frames"]) for clip in clips] if all("frames" in c for c in clips) else None


def list_sources(clips: list[dict]) -> list[str | int]:
    """Return the photograph or video that each clip shows, a number where it shows none."""
    return [clip.get("source") or number for number, clip in enumerate(clips)]


def write_and_print_results(
    run: Path, config: str, rows: list[ScoreRow], table: RenderableType | None = None,
    note: str = "", **facts,
) -> dict:  # fmt: skip
    """Write `results.json` and `clips.csv` of the first row into `run` and print all rows, or
    `table` for them, with the line `note` below.

    `facts`: further entries of `results.json` (task, experiment, seed, wall_s, device ...), whose
    content is returned.  Raises ValueError where `run` holds results of another config.
    """
    has_results(run, config)  # of a process that came later, where nothing holds the folder
    first = rows[0]
    model = {name: getattr(first, name) for name in ("name", "params", "macs_per_frame")}
    record = {
        "schema": SCHEMA,
        **facts,
        "git": git_commit(),
        "config_sha256": hash_config(config),
        "model": model,
        "test": summarize_scores(first.clips, first.own_metrics),
        "latency_ms": first.latency_ms_by_size,
        "compared": {row.name: summarize_scores(row.clips, row.own_metrics) for row in rows[1:]},
    }
    if first.own_metrics:  # a report has no other way to know which values are better
        record["own_metrics"] = {metric.name: metric.better for metric in first.own_metrics}
    columns = list(first.clips[0])
    values = [[clip[name] for name in columns] for clip in first.clips]
    write_text(run / "clips.csv", format_csv(columns, values))
    write_text(run / "results.json", json.dumps(record, indent=2) + "\n")
    rich.print(table or build_rich_score_table(rows))
    if note:
        print(note)
    found = [*run.glob("*.*"), *run.glob("*/*.*")]  # not the thousands of saved frames below
    files = sorted(str(file.relative_to(run)) for file in found if file.is_file())
    print(f"in {run}: " + ", ".join(file for file in files if not file.startswith(".")))
    return record


def format_csv(heads: Iterable, rows: Iterable[Iterable]) -> str:
    """Return a table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([heads, *rows])
    return text.getvalue()


def build_rich_score_table(rows: list[ScoreRow]) -> Table:
    """Return mean scores over clips, one line per network; arrows point to better values."""
    title = f"{len(rows[0].clips)} test clips, mean of per-frame values"
    picture = Table(title=title, box=box.SIMPLE_HEAD, show_edge=False, padding=(0, 1, 0, 0))
    picture.add_column("network", overflow="fold")
    metrics = (*METRICS, *rows[0].own_metrics)
    for metric in metrics:
        heading = re.sub(r" (?![↑↓])", "\n", metric.title)  # narrow: names take the rest
        picture.add_column(heading, justify="right", overflow="fold")
    picture.add_column("ms/frame", justify="right", overflow="fold")
    for row in rows:
        means = summarize_scores(row.clips, row.own_metrics)
        cells = [m.format_value(means.get(m.name, {}).get("mean")) for m in metrics]
        picture.add_row(row.name, *cells, f"{next(iter(row.latency_ms_by_size.values())):.1f}")
    return picture


def describe_score_difference(ours: ScoreRow, theirs: ScoreRow) -> str:
    """Return a line of the first metric that both have: its difference over the same clips with the
    95 % bootstrap CI; "" without one, as of fewer than two clips."""
    metric = next(
        (m for m in METRICS if m.name in ours.clips[0] and m.name in theirs.clips[0]), None
    )
    if metric is None:
        return ""
    sides = [[float(clip[metric.name]) for clip in row.clips] for row in (ours, theirs)]
    change = statistics.fmean(sides[0]) - statistics.fmean(sides[1])
    groups = list_sources(ours.clips)
    low, high = bootstrap_difference_interval(sides[:1], sides[1:], groups=groups)
    if math.isnan(low):
        return ""
    digits = metric.digits + 1
    said = ": it holds 0, so no difference is shown" if low <= 0 <= high else ""
    return (
        f"{metric.heading}, {ours.name} less {theirs.name}: {change:+.{digits}f}, "
        f"95 % CI {low:+.{digits}f} to {high:+.{digits}f}{said}"
    )


def git_commit() -> str:
    """Return the commit of the working tree, with `-dirty` where it differs; else `unknown`."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
    here = Path(__file__).parent
    try:
        return subprocess.check_output(command, cwd=here, text=True, stderr=subprocess.PIPE).strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
