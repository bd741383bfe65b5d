"""Settings that are documented can be set, and none reaches outside the repository."""

import pytest
import yaml

from src.app import build
from src.sim.pipeline import simulate
from tests.conftest import ROOT
from tests.test_train import config, names

SMALL = ["scene.height=64", "scene.width=64", "data.test_windows=2", "data.test_crop=16"]


@pytest.mark.parametrize("choice", names("turbulence"))
def test_every_setting_of_turbulence_can_be_set_whatever_its_strength(choice, tmp_path):
    settings = ["turbulence.modes=9", "turbulence.tolerance=0.5", "turbulence.temporal=flow"]
    cfg = config("simulate", tmp_path, f"turbulence={choice}", *settings, *SMALL)
    (drawn,) = simulate(build.pipeline(cfg, "test"), [0]).drawn
    assert drawn["modes"] == (0 if choice == "none" else 9)


def values(node: object) -> list:
    """Every scalar of nested mappings and lists."""
    if isinstance(node, dict | list):
        parts = node.values() if isinstance(node, dict) else node
        return [value for part in parts for value in values(part)]
    return [node]


def test_no_setting_points_outside_a_clone():
    for file in sorted((ROOT / "conf").rglob("*.yaml")):
        words = [value for value in values(yaml.safe_load(file.read_text())) if type(value) is str]
        outside = [word for word in words if word.startswith(("/", "~", "..")) and "/" in word[1:]]
        assert not outside, (file, outside)


@pytest.mark.parametrize("budget", names("budget"))
def test_the_budget_does_not_undo_a_choice_of_augmentation(budget, tmp_path):
    chosen = {
        name: config("train", tmp_path, f"budget={budget}", f"augment={name}").augment.noise_std
        for name in names("augment")
    }
    assert chosen["none"] == chosen["flips"] == 0 and chosen["e2vid_plus"] == 0.1
    assert chosen["paper"] == chosen["views"] > 0
