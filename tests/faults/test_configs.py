"""A config from elsewhere builds classes of this house and runs nothing else."""

import math
import sys
from collections.abc import Iterator
from itertools import product

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from src.app import parts
from src.simulate import SAME
from tests.faults.test_inputs import read_config, run_config

FOREIGN = [
    "os.system",
    "builtins.eval",
    "subprocess.Popen",
    "src.app.build.os.getcwd",
    "src.app.parts.instantiate",
    "src.models.files.save",
    "src.records.results.write_text",
    "src.records.results.Path",
    "torch.optim.adam.torch.load",
    "torch.load",
    "lightning.fabric.utilities.cloud_io._load",
    "lightning.pytorch.cli.LightningCLI",
    "antigravity.geohash",
    "",
    "..",
    "src.nowhere.X",
]


@pytest.mark.parametrize("target", FOREIGN)
def test_only_classes_of_the_rooms_are_built(target):
    foreign = {"_target_": target}
    for node in (foreign, {"_target_": "src.sim.optics.Optics", "views": {"a": [foreign]}}):
        with pytest.raises(ValueError, match="_target_ must"):
            parts.make(OmegaConf.create(node))
    assert "antigravity" not in sys.modules


WORDS = ["src", "build", "models", "files", "optim", "torch", "os", "system", "lightning", "hub"]
WORDS += ["pytorch", "callbacks", "load", "sim", "optics", "Optics", "metrics", "results", "Path"]
WORDS += ["write_text", "pickle", "loads", "__init__", "__class__"]
NAMES = st.lists(st.sampled_from(WORDS), min_size=1, max_size=5).map(".".join)


@pytest.mark.parametrize("prefix", ["src.", "baselines.", "torch.optim.", "lightning.pytorch."])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(name=NAMES)
def test_no_name_leads_out_of_the_rooms(prefix, name):
    try:
        made = parts.make(OmegaConf.create({"_target_": prefix + name, "_partial_": True}))
    except ValueError as error:
        assert "_target_" in str(error)
    else:
        assert f"{made.func.__module__}.".startswith(parts.ROOMS)


def test_yaml_builds_plain_values_only():
    with pytest.raises(yaml.YAMLError):
        OmegaConf.create("a: !!python/object/apply:os.getcwd []")


WRONG = [None, -1, 0, 3, 10**30, 1e308, math.nan, math.inf, True, "x", "${x}", [], [1], [0.5, 0.1]]
WRONG += [["x"], {}, {"a": 1}]


def places(section: dict) -> Iterator[tuple[dict, str]]:
    """Yield (mapping, key) of every value in nested mappings."""
    for key, value in section.items():
        yield section, key
        if isinstance(value, dict):
            yield from places(value)


@pytest.mark.parametrize("every", [17, pytest.param(1, marks=pytest.mark.slow)])
def test_wrong_values_are_refused_by_name(every, tmp_path):
    run_config(tmp_path / "whole.yaml")
    whole = yaml.safe_load((tmp_path / "whole.yaml").read_text())
    part = {name: whole[name] for name in SAME}
    tried = refused = 0
    for number, ((mapping, key), wrong) in enumerate(product(list(places(part)), WRONG)):
        if number % every:
            continue
        right, mapping[key] = mapping[key], wrong
        (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(part))
        mapping[key] = right
        tried += 1
        try:
            read_config(tmp_path / "wrong.yaml")
        except ValueError as error:
            assert str(error), (key, wrong)
            refused += 1
    print(f"config values: {tried} wrong ones tried, {refused} refused, 0 crashes")
    assert tried > 1000 / every and refused > tried / 4
