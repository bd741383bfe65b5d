"""A config from elsewhere builds classes of this project and runs nothing else."""

import math
import sys
from itertools import product

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from src.app import instantiate
from src.simulate import CLIP_KEYS
from tests.faults.test_damaged_files import read_config, write_config

FOREIGN = [
    "os.system", "builtins.eval", "subprocess.Popen", "src.app.build.os.getcwd", "torch.load", "",
    "src.app.instantiate.instantiate", "src.models.files.save", "src.records.results.write_text",
    "src.records.results.Path", "torch.optim.adam.torch.load", "..", "src.nowhere.X",
    "antigravity.geohash", "lightning.fabric.utilities.cloud_io._load",
    "lightning.pytorch.cli.LightningCLI",
]  # fmt: skip
NAMES = [
    "src", "build", "models", "files", "optim", "torch", "os", "system", "lightning", "hub",
    "pytorch", "callbacks", "load", "sim", "optics", "Optics", "metrics", "results", "Path",
    "write_text", "pickle", "loads", "__init__", "__class__",
]  # fmt: skip
WRONG = [None, -1, 0, 3, 10**30, 1e308, math.nan, math.inf, True, "x", "${x}", [], [1], [0.5, 0.1]]
WRONG += [["x"], {}, {"a": 1}]


@pytest.mark.parametrize("target", FOREIGN)
def test_only_classes_of_allowed_packages_are_built(target):
    foreign = {"_target_": target}
    for node in (foreign, {"_target_": "src.sim.optics.Optics", "views": {"a": [foreign]}}):
        with pytest.raises(ValueError, match="_target_ must"):
            instantiate.instantiate_node(OmegaConf.create(node))
    assert "antigravity" not in sys.modules


@pytest.mark.parametrize("prefix", ["src.", "baselines.", "torch.optim.", "lightning.pytorch."])
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(name=st.lists(st.sampled_from(NAMES), min_size=1, max_size=5).map(".".join))
def test_no_name_leads_out_of_the_allowed_packages(prefix, name):
    node = OmegaConf.create({"_target_": prefix + name, "_partial_": True})
    try:
        built = instantiate.instantiate_node(node)
    except ValueError as error:
        assert "_target_" in str(error)
    else:
        assert f"{built.func.__module__}.".startswith(instantiate.ALLOWED_PACKAGES)


def test_yaml_builds_plain_values_only():
    with pytest.raises(yaml.YAMLError):
        OmegaConf.create("a: !!python/object/apply:os.getcwd []")


def places(section: dict) -> list[tuple[dict, str]]:
    """Return (mapping, key) of every value in nested mappings."""
    inner = [
        found for value in section.values() if isinstance(value, dict) for found in places(value)
    ]
    return [(section, key) for key in section] + inner


@pytest.mark.parametrize("every", [17, pytest.param(1, marks=pytest.mark.slow)])
def test_wrong_values_are_refused_by_name(every, tmp_path):
    write_config(tmp_path / "whole.yaml")
    whole = yaml.safe_load((tmp_path / "whole.yaml").read_text())
    part = {name: whole[name] for name in CLIP_KEYS}
    cases = list(product(places(part), WRONG))[::every]
    refused = 0
    for (mapping, key), wrong in cases:
        right, mapping[key] = mapping[key], wrong
        (tmp_path / "wrong.yaml").write_text(yaml.safe_dump(part))
        mapping[key] = right
        try:
            read_config(tmp_path / "wrong.yaml")
        except ValueError as error:
            assert str(error), (key, wrong)
            refused += 1
    print(f"config values: {len(cases)} wrong ones tried, {refused} refused, 0 crashes")
    assert len(cases) > 1000 / every and refused > len(cases) / 4
