"""Settings that are documented can be set, and none reaches outside the repository."""

import pytest
import torch
import yaml

from src.app import simulation
from src.sim.pipeline import ClipParameters, simulate
from tests.conftest import ROOT
from tests.test_train import config, names

SMALL = ["scene.height=64", "scene.width=64", "data.test_windows=2", "data.test_crop=16"]


@pytest.mark.parametrize("choice", ["none", "weak", "medium", "strong", "extreme", "mixed"])
def test_every_setting_of_turbulence_can_be_set_whatever_its_strength(choice, tmp_path):
    settings = ["turbulence.tolerance=0.5", "turbulence.temporal_model=frozen_flow"]
    cfg = config("simulate", tmp_path, f"turbulence={choice}", "fps=120", *settings, *SMALL)
    assert len(simulate(simulation.build_pipeline(cfg, "test"), [0]).parameters) == 1


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
    own = config("train", tmp_path, f"budget={budget}").voxel_noise_std
    assert chosen["paper"] == chosen["views"] == own


def drawn(entry_point: str, run, split: str, *overrides: str) -> ClipParameters:
    return simulation.build_pipeline(
        config(entry_point, run, *SMALL, "data.crop=16", *overrides), split
    ).draw(0)


def same(one: ClipParameters, other: ClipParameters) -> bool:
    return torch.equal(one.clip.frames, other.clip.frames) and one.turbulence == other.turbulence


def test_trainings_of_several_seeds_are_tested_on_the_same_clips(tmp_path):
    tests, trainings = (
        [drawn("train", tmp_path, split, f"seed={seed}") for seed in (0, 1)]
        for split in ("test", "train")
    )
    assert same(*tests) and not same(*trainings)
    assert not same(tests[0], drawn("train", tmp_path, "test", "data.test_seed=1"))


@pytest.mark.parametrize("entry_point", ["eval", "chart", "stress", "simulate", "calibrate"])
def test_without_a_training_the_seed_is_that_of_the_test_clips(entry_point, tmp_path):
    needed = {"calibrate": ["task=threshold", "fps=120"], "simulate": ["fps=120"]}
    given = needed.get(entry_point, [])
    one, other = (drawn(entry_point, tmp_path, "test", f"seed={seed}", *given) for seed in (0, 1))
    assert not same(one, other)
