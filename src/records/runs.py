"""Finished runs and sweeps, read from their folders whatever these are called."""

import csv
import json
import math
import os
import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from src import COMMAND
from src.metrics.table import NAMES
from src.records import results, safe_yaml

FIGURES = ("chart", "machine", "stress")  # of src.chart and src.stress
WITHOUT_NUMBERS = ("seed", "name", "task", "logger", "callbacks", "paths", "hydra")
MACHINE = ("data.workers", "data.simulate_on", "trainer.accelerator")
PROCESSES = ("trainer.devices", "trainer.num_nodes")  # the joint batch of a training
HYDRA_FOLDER = ".hydra"  # in the folder of a run: its config.yaml is no second run's
READ_ERRORS = (
    OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError, yaml.YAMLError,
)  # fmt: skip


@dataclass(frozen=True)
class Run:
    """One `results.json`, with the resolved config as {dotted key: value} and its clips' scores."""

    folder: Path
    record: dict
    settings: dict[str, Any]
    clips: list[dict[str, str]]

    @property
    def choices(self) -> dict[str, str]:
        """Config group -> chosen option, the experiment first."""
        chosen = {"task": self.record["task"], "experiment": self.record["experiment"]}
        asked = self.record.get("asked", {}).get("choices", {})
        return chosen | {k: str(v) for k, v in asked.items() if k not in WITHOUT_NUMBERS}

    @property
    def sweep(self) -> str:
        """The name of its sweep, such as table1; "" without one."""
        config = self.record.get("asked", {}).get("config", "")
        return "" if config == self.record["task"] else config

    @property
    def overrides(self) -> list[str]:
        return self.record.get("asked", {}).get("overrides", [])

    @property
    def result_settings_without_seed(self) -> dict[str, Any]:
        """The settings that numbers depend on but the seed, as {dotted key: value}."""
        train = self.record["task"] == "train"
        return {k: value for k, value in self.settings.items() if is_result_setting(k, train)}

    @property
    def test_seed(self) -> int:
        return self.settings.get("data.test_seed", self.record["seed"])


@dataclass(frozen=True)
class SweepPlan:
    """A sweep: its config name, its command line and the overrides of each of its jobs."""

    sweep: str
    command: str
    jobs: list[list[str]]


def is_result_setting(key: str, train: bool) -> bool:
    """Return whether numbers of a training (`train`), or of a test, depend on a setting other than
    the seed; where nothing is trained `data.test_seed` is the seed."""
    same = MACHINE if train else (*MACHINE, *PROCESSES, "data.test_seed")
    return key.split(".")[0] not in WITHOUT_NUMBERS and key not in same


def find_runs(folders: list[Path]) -> list[Run]:
    """Return the runs at or below `folders`, oldest first.  Raises ValueError for a folder without
    results, and for a file that is no `results.json` of this schema."""
    unique: dict[Path, Path] = {}
    for folder in folders:
        if not folder.is_dir():
            raise ValueError(f"run must be folders of runs, got {folder}: no such folder")
        files = list(folder.rglob("results.json"))
        if not files and not find_charts_and_stress_maps([folder]):
            raise ValueError(f"run must hold results.json, got {folder}: empty or not finished")
        unique |= {file.resolve(): file for file in files}
    runs = map(_read, unique.values())
    return sorted(runs, key=lambda r: ((r.folder / "results.json").stat().st_mtime, str(r.folder)))


def find_unfinished_runs(folders: list[Path]) -> list[Path]:
    """Return the folders of tests and trainings without results at or below `folders`, but for the
    jobs of sweeps, which their plans tell."""
    jobs = {f.parent.resolve() for folder in folders for f in folder.rglob("multirun.yaml")}
    found = dict.fromkeys(f.parent for folder in folders for f in folder.rglob("config.yaml"))
    return [
        run for run in found
        if run.name != HYDRA_FOLDER and not (run / "results.json").is_file()
        and not jobs & set(run.resolve().parents)
        and _read_task(run / "config.yaml") in ("train", "eval")
    ]  # fmt: skip


def find_sweeps(folders: list[Path]) -> list[SweepPlan]:
    """Return the sweeps whose `multirun.yaml` lies at or below `folders`."""
    files = {f.resolve() for folder in folders for f in folder.rglob("multirun.yaml")}
    return [_plan(safe_yaml.read(file)["hydra"]) for file in sorted(files)]


def find_charts_and_stress_maps(folders: list[Path]) -> list[Path]:
    """Return the charts and heat maps at or below `folders`; the vector picture where both are."""
    pictures: dict[tuple[Path, str], Path] = {}
    for folder in folders:
        for name in (f"{stem}{suffix}" for stem in FIGURES for suffix in (".png", ".svg")):
            pictures |= {(f.resolve().parent, f.stem): f for f in sorted(folder.rglob(name))}
    return list(pictures.values())


def flatten_settings(node: Any, prefix: str = "") -> dict[str, Any]:
    """Return {dotted key: value} of nested dicts; lists are values."""
    if not isinstance(node, dict) or not node:
        return {prefix: node}
    flat: dict[str, Any] = {}
    for name, child in node.items():
        flat |= flatten_settings(child, f"{prefix}.{name}" if prefix else str(name))
    return flat


def _read_task(config: Path) -> str | None:
    try:
        return safe_yaml.read(config).get("task")
    except READ_ERRORS:
        return None


def _find_start_weights(record: dict) -> str | None:
    """Return the weights that a training went on from; None for those of an earlier part of it, a
    checkpoint or the folder of a run."""
    name = record.get("resumed_from")
    if not name or name.endswith(".ckpt") or Path(name).is_dir():
        return None
    return name


def _count_processes(devices: Any) -> Any:
    """Return how many devices `trainer.devices` names: [0, 2] are two; auto stays."""
    return len(devices) if isinstance(devices, list) else devices


def _read(file: Path) -> Run:
    try:
        record = json.loads(file.read_text())
        schema, config = record["schema"], (file.parent / "config.yaml").read_text()
        is_of_config = record.get("config_sha256") == results.hash_config(config)
        settings = flatten_settings(results.parse_settings_without_paths(config))
        if record.get("task") == "train":
            settings["ckpt"] = _find_start_weights(record)
            settings["trainer.devices"] = _count_processes(settings.get("trainer.devices", 1))
            settings.setdefault("trainer.num_nodes", 1)
    except READ_ERRORS as error:
        raise ValueError(f"run must hold whole results, got {file}: {error}") from error
    if schema != results.SCHEMA:
        raise ValueError(f"schema must be {results.SCHEMA}, got {schema} in {file}")
    if not is_of_config:
        raise ValueError(f"run must hold whole results, got {file}: config.yaml is of another run")
    try:
        return Run(file.parent, record, settings, _read_clips(file.parent / "clips.csv", record))
    except READ_ERRORS as error:
        raise ValueError(f"run must hold whole results, got {file}: {error}") from error


def _read_clips(file: Path, record: dict) -> list[dict[str, str]]:
    """Return the scores of clips, without those that a clip does not have, none where there is no
    file.  Raises one of READ_ERRORS where the file, or what `record` says of the test, is cut
    short, and where their means differ."""
    test = record["test"]
    scores = [score for name, score in test.items() if name != "clips"]
    if not record["latency_ms"] or any("mean" not in score for score in scores):
        raise ValueError("scores or times are missing")
    rows = list(csv.DictReader(file.read_text().splitlines())) if file.is_file() else []
    if file.is_file() and len(rows) != test["clips"]:
        raise ValueError(f"{file.name} has {len(rows)} clips, the test had {test['clips']}")
    if any(None in row or None in row.values() for row in rows):
        raise ValueError(f"{file.name} is cut short")
    clips = [{k: text for k, text in row.items() if text or k not in NAMES} for row in rows]
    for name in test.keys() & {name for clip in clips for name in clip}:
        _check_mean(name, [clip for clip in clips if name in clip], test[name], file)
    return clips


def _check_mean(name: str, clips: list[dict[str, str]], score: dict, file: Path) -> None:
    values = [float(clip[name]) for clip in clips]
    mean, wanted = statistics.fmean(values, results.frame_weights(clips)), float(score["mean"])
    are_equal = math.isclose(mean, wanted, rel_tol=1e-6, abs_tol=1e-9)
    if not are_equal and not (math.isnan(mean) and math.isnan(wanted)):
        raise ValueError(f"{file.name} has the mean {name} {mean:g}, the test {wanted:g}")


def _plan(hydra: dict) -> SweepPlan:
    asked = list(hydra["overrides"]["task"])
    params = (hydra["sweeper"].get("params") or {}).items()
    lines = [f"{key}={value}" for key, value in params] + asked
    parsed = OverridesParser.create().parse_overrides(lines)
    entry_point, config = hydra["job"]["name"], hydra["job"]["config_name"]
    sweep = "" if entry_point == config else config
    how = f"--config-dir {_find_config_dir(hydra)} --config-name {sweep}" if sweep else "-m"
    start = f"{COMMAND}{entry_point} {how}"
    jobs = BasicSweeper.split_arguments(parsed, None)[0]
    return SweepPlan(sweep, " ".join([start, *asked]), jobs)


def _find_config_dir(hydra: dict) -> str:
    """Return the folder that --config-dir named, from where the sweep was started."""
    runtime = hydra.get("runtime", {})
    named = [
        s["path"] for s in runtime.get("config_sources", ()) if s["provider"] == "command-line"
    ]
    return os.path.relpath(named[0], runtime["cwd"]) if named else "sweeps"
