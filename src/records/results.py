"""The record of a run: its folder, the resolved config, `results.json`, `clips.csv`, the table."""

import csv
import hashlib
import io
import json
import shutil
import statistics
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import rich
from rich.table import Table

from src.metrics.bootstrap import interval
from src.metrics.table import METRICS, NAMES
from src.recordings.files import safe_yaml
from src.records.atomic import write_text

SCHEMA = 1
LEAST_FREE_BYTES = 200 * 2**20


@dataclass(frozen=True)
class Row:
    """What a line of a table needs: scores of every clip with what was drawn for it, and cost."""

    name: str
    clips: list[dict]
    params: int
    macs_per_frame: int
    latency_ms: dict[str, float]


def open_run(run: Path, config: str) -> None:
    """Make the folder `run` and store the resolved `config` (YAML) in it.

    Raises ValueError where the folder cannot be made or the disk is nearly full.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"paths.out must be a folder to write to, got {run}: {error}") from error
    free = shutil.disk_usage(run).free
    if free < LEAST_FREE_BYTES:
        needed = LEAST_FREE_BYTES // 2**20
        raise ValueError(f"paths.out must have {needed} MiB free, got {free // 2**20} MiB at {run}")
    write_text(run / "config.yaml", config)


def content(config: str) -> dict:
    """Return what a resolved `config` (YAML) says of the numbers, and not of where they are put.

    Left out: `paths`, and for training the `ckpt` it went on from (law 6).
    """
    settings = safe_yaml.parse(config)
    run = settings.pop("paths", {}).get("run")
    if settings.get("task") == "train":
        settings.pop("ckpt", None)
    return (
        json.loads(json.dumps(settings).replace(json.dumps(run)[1:-1], "RUN")) if run else settings
    )


def digest(config: str) -> str:
    """Return the SHA-256 of the content of a resolved `config`: the same in every folder."""
    return hashlib.sha256(json.dumps(content(config), sort_keys=True).encode()).hexdigest()


def standing(run: Path, config: str) -> bool:
    """Return whether `run` holds the results of `config` already.

    Raises ValueError where it holds those of another one: a sweep overwrites no result.
    """
    file = run / "results.json"
    if not file.is_file():
        return False
    if json.loads(file.read_text()).get("config_sha256") != digest(config):
        raise ValueError(
            f"paths.out must be another folder, or {run} moved away: it holds results of another "
            "configuration"
        )
    return True


def summary(clips: list[dict]) -> dict:
    """Return {clips, metric: {mean, std, interval}} over clips; the spread of one clip is 0.

    `interval`: 95 % of the means of resampled clips.
    """
    present = [name for name in NAMES if clips and name in clips[0]]
    values = {metric: [clip[metric] for clip in clips] for metric in present}
    return {"clips": len(clips)} | {
        metric: {"mean": statistics.fmean(v), "std": statistics.pstdev(v), "interval": interval(v)}
        for metric, v in values.items()
    }


def write(run: Path, config: str, rows: list[Row], **facts) -> dict:
    """Write `results.json` and `clips.csv` of the first row into `run`, print the table.

    `facts`: task, experiment, seed, wall_s, device ...  Returns the content of `results.json`.
    """
    first = rows[0]
    record = {
        "schema": SCHEMA,
        **facts,
        "git": commit(),
        "config_sha256": digest(config),
        "model": {
            "name": first.name,
            "params": first.params,
            "macs_per_frame": first.macs_per_frame,
        },
        "test": summary(first.clips),
        "latency_ms": first.latency_ms,
        "compared": {row.name: summary(row.clips) for row in rows[1:]},
    }
    write_text(run / "clips.csv", clips_csv(first.clips))
    write_text(run / "results.json", json.dumps(record, indent=2) + "\n")
    rich.print(table(rows))
    files = sorted(str(file.relative_to(run)) for file in run.rglob("*.*") if file.is_file())
    rich.print(f"in {run}: " + ", ".join(file for file in files if not file.startswith(".")))
    return record


def csv_text(heads: Iterable, rows: Iterable[Iterable]) -> str:
    """Return a table as CSV."""
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([heads, *rows])
    return text.getvalue()


def clips_csv(clips: list[dict]) -> str:
    """Return one line per clip: what was drawn for it and its scores."""
    return csv_text(clips[0], [[clip[name] for name in clips[0]] for clip in clips])


def table(rows: list[Row]) -> Table:
    """Return the rows as a table: mean over clips; the arrow says which way is better."""
    picture = Table(title=f"{len(rows[0].clips)} test clips, mean of per-frame values")
    picture.add_column("network")
    for metric in METRICS:
        picture.add_column(f"{metric.heading} {metric.arrow}", justify="right")
    picture.add_column("ms/frame", justify="right")
    for row in rows:
        means = summary(row.clips)
        cells = [m.written(means.get(m.name, {}).get("mean")) for m in METRICS]
        picture.add_row(row.name, *cells, f"{next(iter(row.latency_ms.values())):.1f}")
    return picture


def commit() -> str:
    """Return the commit of the working tree, with `-dirty` where it differs; else `unknown`."""
    try:
        words = ["git", "describe", "--always", "--dirty", "--abbrev=12"]
        return subprocess.run(
            words, cwd=Path(__file__).parent, capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
