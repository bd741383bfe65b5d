"""The door stress at a tiny size: map, table and text; what cannot run says why."""

import csv

import pytest

from src.stress import stress
from tests.test_train import config

HIGHPASS = "{baseline: {_target_: baselines.highpass.HighPass, source: median}, views: 9}"
ABSENT = "{ckpt: nowhere, views: 9}"
SETNET = "{ckpt: nowhere, views: 9, model: {_target_: src.models.setnet.SetNet}}"
PROBES = "{hold: {title: held, probe: {_target_: src.bench.probes.memory.Hold, windows: [2, 4]}}, "
PROBES += "lost: {title: lost, probe: {_target_: src.bench.probes.light_field.Lost, "
PROBES += "counts: [1], draws: 1}}, "
PROBES += "fast: {title: fast, probe: {_target_: src.bench.probes.sampling.Rates, rates: [1200]}}}"
TINY = ["clips=1", "scene.height=64", "scene.width=64", "data.test_crop=32", "data.test_windows=20"]
TINY += ["data.warmup=2", "processes=1", f"+probes={PROBES}"]


def tiny(tmp_path, *overrides: str):
    return config("stress", tmp_path, "~probes", "~networks", *TINY, *overrides)


def test_map_table_and_text_are_written(tmp_path):
    networks = f"+networks={{median: {HIGHPASS}, absent: {ABSENT}, untrained: {SETNET}}}"
    found = stress(tiny(tmp_path, networks))
    assert found["hold"]["median"].failed
    assert "nowhere" in found["hold"]["absent"] and "no weights" in found["hold"]["untrained"]
    assert all((tmp_path / f"stress.{suffix}").is_file() for suffix in ("png", "svg", "csv", "md"))
    lines = list(csv.DictReader((tmp_path / "stress.csv").read_text().splitlines()))
    assert {line["network"] for line in lines} == {"median", "absent", "untrained"}
    text = (tmp_path / "stress.md").read_text()
    assert "held" in text and "Not run, because" in text


def test_a_single_view_has_no_views_to_lose(tmp_path):
    networks = "+networks={one: {baseline: {_target_: baselines.highpass.HighPass}, views: 1}}"
    assert "centre view only" in stress(tiny(tmp_path, networks))["lost"]["one"]


def test_a_checkpoint_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ValueError, match="ckpt must be a file"):
        stress(tiny(tmp_path, "+networks={}", "ckpt=[nowhere]"))


def test_an_entry_of_networks_without_views_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"networks\.bad must have views"):
        stress(tiny(tmp_path, "+networks={bad: {ckpt: nowhere}}"))


def test_two_processes_find_what_one_does(tmp_path):
    one = "one: {baseline: {_target_: baselines.highpass.HighPass}, views: 1}"
    networks = f"+networks={{median: {HIGHPASS}, {one}}}"
    stress(tiny(tmp_path / "a", networks))
    stress(tiny(tmp_path / "b", networks, "processes=2"))
    texts = [(tmp_path / name / "stress.csv").read_text() for name in "ab"]
    assert texts[0] == texts[1]


def test_no_process_at_all_is_refused(tmp_path):
    with pytest.raises(ValueError, match="processes must be >= 1, got 0"):
        stress(tiny(tmp_path, "+networks={}", "processes=0"))
