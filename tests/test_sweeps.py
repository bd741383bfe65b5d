"""Every sweep is a multirun whose jobs compose, and whose first and last job run, tiny."""

from pathlib import Path

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from src.train import train
from tests.conftest import ROOT
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
    assert f"/{path.stem}/" in sweep["hydra"]["sweep"]["dir"]
    found = jobs(path)
    assert len(found) == len({tuple(job) for job in found}) >= 3
    for override in {override for job in found for override in job}:
        config("train", tmp_path, override)
    for place in (0, -1):
        run = tmp_path / str(place)
        train(config("train", run, *found[place], *TINY, "logger=none"))
        assert (run / "results.json").is_file()
