"""Scene, turbulence, sensor and network keep their contracts; so must a class of one's own."""

import pytest
import torch
from omegaconf import OmegaConf

from baselines.highpass import HighPass
from src.app import build
from src.app.contracts import CONTRACTS, keeping
from src.models.setnet import SetNet
from src.sim.pipeline import simulate
from src.sim.scenes.photographs import MixedRates
from src.sim.sensor import EventSensor
from tests.test_train import config

SMALL = ["data.test_windows=2", "scene.height=32", "scene.width=32", "turbulence=none"]


def test_the_config_of_an_older_run_which_names_no_sensor_gives_the_same_events(tmp_path):
    cfg = config("simulate", tmp_path, *SMALL, "sensor=noisy", "sensor.input=srgb")
    older = OmegaConf.create(OmegaConf.to_yaml(cfg, resolve=True))
    del older.sensor["_target_"]
    ours, theirs = (simulate(build.pipeline(c, "test"), [1]) for c in (cfg, older))
    assert torch.equal(ours.voxels, theirs.voxels) and ours.voxels.any()


@pytest.mark.parametrize(
    "key, found", [("sensor", EventSensor()), ("scene", MixedRates([])), ("model", SetNet()),
                   ("baseline", HighPass()), ("optics", object())],
)  # fmt: skip
def test_what_is_here_keeps_its_contract(key, found):
    assert keeping(key, found) is found


@pytest.mark.parametrize("key", CONTRACTS)
def test_what_lacks_something_is_refused_by_name(key):
    lacks = {"scene": "clip", "turbulence": "draw, operator", "sensor": "draw, drawn, threshold, "}
    lacking = lacks.get(key, "forward, views")
    with pytest.raises(ValueError, match=rf"{key}._target_ must be a class with {lacking}"):
        keeping(key, object())
