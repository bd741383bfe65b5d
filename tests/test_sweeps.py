"""Every sweep is a multirun whose jobs compose, and whose first and last job run, tiny."""

import json
import subprocess
from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from src.metrics import results
from src.train import train
from tests.conftest import ROOT
from tests.test_door import command, environment
from tests.test_train import TINY, config

SWEEPS = sorted((ROOT / "sweeps").glob("*.yaml"))


def content(path: Path) -> dict:
    return OmegaConf.to_container(OmegaConf.load(path), resolve=False)


def jobs(path: Path) -> list[list[str]]:
    params = content(path)["hydra"]["sweeper"]["params"]
    overrides = [f"{key}={value}" for key, value in params.items()]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return BasicSweeper.split_arguments(parsed, max_batch_size=None)[0]


@pytest.mark.parametrize("path", SWEEPS, ids=lambda path: path.stem)
def test_every_job_composes_and_two_run(path, tmp_path):
    sweep = content(path)
    assert sweep["defaults"] == ["train", "_self_"] and sweep["hydra"]["mode"] == "MULTIRUN"
    assert "sweep" not in sweep["hydra"]  # the folder follows from the name: conf/hydra
    found = jobs(path)
    assert len(found) == len({tuple(job) for job in found}) >= 3
    for override in {override for job in found for override in job}:
        config("train", tmp_path, override)
    for place in (0, -1):
        run = tmp_path / str(place)
        train(config("train", run, *found[place], *TINY, "logger=none"))
        assert (run / "results.json").is_file()


SCORED = ["-m", "baseline=highpass", "debug=fdr", "metrics.lpips=null"]


def sweep(folder: Path, *overrides: str) -> subprocess.CompletedProcess:
    line = command("eval", *SCORED, *overrides, f"paths.out={folder}")
    return subprocess.run(line, cwd=ROOT, env=environment(), capture_output=True, text=True)


def test_a_failed_job_is_named_and_the_rest_stands(tmp_path):
    first = sweep(tmp_path, "data.test_crop=1000,32")
    assert first.returncode == 1 and "Traceback" not in first.stderr
    assert "error: 1 failed" in first.stderr and "data.test_crop=1000" in first.stderr
    done = sorted(tmp_path.rglob("results.json"))
    (failed,) = tmp_path.rglob("failed.txt")
    assert len(done) == 1 and "Traceback" in failed.read_text()
    times = [file.stat().st_mtime_ns for file in done]

    second = sweep(tmp_path, "data.test_crop=32")
    assert second.returncode == 0, second.stderr
    assert second.stdout.count("skipped, its results stand") == 1
    assert [file.stat().st_mtime_ns for file in done] == times


CONFIG = "task: {task}\nckpt: {ckpt}\nlr: {lr}\npaths:\n  run: {run}\nlogger:\n  dir: {run}/logs\n"


def test_a_digest_knows_numbers_but_no_folders():
    plain = {"task": "train", "ckpt": "null", "lr": 1, "run": "/a"}
    digests = [
        results.digest(CONFIG.format(**plain | change))
        for change in ({}, {"run": "/b c"}, {"ckpt": "x.ckpt"}, {"lr": 2})
    ]
    assert digests[0] == digests[1] == digests[2] != digests[3]
    evaluated = [CONFIG.format(**plain | {"task": "eval", "ckpt": ckpt}) for ckpt in "ab"]
    assert results.digest(evaluated[0]) != results.digest(evaluated[1])


def test_results_of_another_configuration_are_not_overwritten(tmp_path):
    config = CONFIG.format(task="train", ckpt="null", lr=1, run=tmp_path)
    assert not results.standing(tmp_path, config)
    record = {"config_sha256": results.digest(config)}
    (tmp_path / "results.json").write_text(json.dumps(record))
    assert results.standing(tmp_path, config)
    with pytest.raises(ValueError, match="paths.out"):
        results.standing(tmp_path, config.replace("lr: 1", "lr: 2"))
