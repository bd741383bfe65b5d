"""A key of an earlier version ends in one line that names the new key, wherever it was given."""

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from src.app import renamed_keys
from src.app.compose import compose_config
from tests.conftest import ROOT

ENTRY_POINTS = sorted(file.stem for file in (ROOT / "conf").glob("*.yaml"))


@pytest.mark.parametrize(
    ("key", "explanation"),
    [
        ("calm", "calm is now loss.static_flicker.weight"),
        ("calm.inner", "calm.inner is now loss.static_flicker.weight.inner"),
        ("calmer", None),
        ("seed", None),
    ],
)
def test_a_key_below_a_former_one_is_renamed_with_it(key, explanation):
    assert renamed_keys.describe_renaming(key) == explanation


def test_the_longest_former_key_wins_and_a_removed_one_says_so(monkeypatch):
    monkeypatch.setattr(renamed_keys, "RENAMED_KEYS", {"a": "b", "a.c": "d", "e": None})
    keys = ("a.c.x", "a.x", "e.x")
    expected = ["a.c.x is now d.x", "a.x is now b.x", "e.x was removed"]
    assert [renamed_keys.describe_renaming(key) for key in keys] == expected


def test_a_former_key_in_a_config_file_is_refused():
    with pytest.raises(ValueError, match="^calm is now loss.static_flicker.weight$"):
        renamed_keys.refuse_renamed_keys(OmegaConf.create({"seed": 0, "calm": 1}))


@pytest.mark.parametrize(
    ("name", "override", "said"),
    [
        ("simulate", "vidoe=x", "vidoe is no key of the configuration; did you mean video?"),
        ("simulate", "data.unknown=1", "data.unknown is no key of the configuration; --cfg job"),
        ("train", "optimizer.lrr=1", "optimizer.lrr is no key of the configuration; did you mean"
                                     " optimizer.lr?"),
        ("train", "callbacks.checkpoint.monitor=x",
         "callbacks.checkpoint.monitor is no key of the configuration; "
         "+callbacks.checkpoint.monitor=... adds it to the arguments of callbacks.checkpoint"),
        ("train", "~optimizer.momentum", "optimizer.momentum is no key of the configuration; --"),
        ("eval", "verbose=true", "verbose was removed"),
        ("chart", "trainer=gpu", "trainer is no key of the configuration; --cfg job"),
        ("stress", "trainer=gpu", "trainer is no key of the configuration; --cfg job"),
        ("train", "experiment=clean/x", "experiment must be one of lf3x3, mambatm, "),
        ("live", "reading=defalt", "reading must be one of default, got defalt; did you mean"
                                   " default?"),
    ],
)  # fmt: skip
def test_a_key_or_choice_that_is_none_names_the_nearest(name, override, said):
    with pytest.raises(ValueError) as caught:
        compose_config(name, override)
    assert str(caught.value).startswith(said) and "provider" not in str(caught.value)


def test_a_key_that_only_the_default_choice_has_is_no_neighbour_of_itself():
    with pytest.raises(ValueError, match="^scene.root is no key of the chosen scene; --cfg job"):
        compose_config("eval", "scene=targets", "scene.root=x")


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
def test_no_entry_point_has_a_former_key(entry_point):
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        cfg = compose(entry_point)
    renamed_keys.refuse_renamed_keys(cfg)
