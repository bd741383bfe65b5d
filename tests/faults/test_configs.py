"""A config from elsewhere builds classes of this house and runs nothing else."""

import sys

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from src import build

FOREIGN = [
    "os.system",
    "builtins.eval",
    "subprocess.Popen",
    "src.build.os.getcwd",
    "src.build.instantiate",
    "src.models.files.save",
    "src.metrics.results.write_text",
    "src.metrics.results.Path",
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
            build.make(OmegaConf.create(node))
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
        made = build.make(OmegaConf.create({"_target_": prefix + name, "_partial_": True}))
    except ValueError as error:
        assert "_target_" in str(error)
    else:
        assert f"{made.func.__module__}.".startswith(build.ROOMS)


def test_yaml_builds_plain_values_only():
    with pytest.raises(yaml.YAMLError):
        OmegaConf.create("a: !!python/object/apply:os.getcwd []")
