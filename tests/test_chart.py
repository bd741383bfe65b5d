"""The door chart at a tiny size: figures, tables, and rows without weights."""

import csv

import pytest
import torch

from baselines.mambatm import MambaTM
from src.chart import chart
from src.models import save
from src.models.setnet import SetNet
from tests.test_train import config

HIGHPASS = "{baseline: {_target_: baselines.highpass.HighPass}, views: 1}"
SETNET = "{views: 9, model: {_target_: src.models.setnet.SetNet, half: 4}}"
TINY = ["clips=2", "scene.height=64", "scene.width=64", "data.test_crop=32", "data.test_windows=4"]
TINY += ["data.warmup=1", "metrics.lpips=null", "sizes=[32]", "seconds=0.01", "threads=[1]"]
TINY += [
    "severities=[weak]",
    "forms=[float32,bf16]",
    "adapt=air",
    "adapt.levels=[[nowhere,1],[nowhere,9]]",
]


def tiny(tmp_path, *overrides: str):
    return config("chart", tmp_path, "~networks", *TINY, *overrides)


def test_figures_and_tables_are_written_and_untrained_networks_timed_only(tmp_path):
    found = chart(tiny(tmp_path, f"+networks={{highpass: {HIGHPASS}, ours: {SETNET}}}"))
    assert found == {"weak": "highpass"}
    for name in ("chart.png", "chart.svg", "machine.png", "machine.svg", "chart.md"):
        assert (tmp_path / name).is_file()
    speeds = list(csv.DictReader((tmp_path / "speed.csv").read_text().splitlines()))
    ours = [row for row in speeds if row["network"] == "ours"]
    assert {row["form"] for row in ours} == {"float32", "bf16"}
    assert all(float(row["ms"]) > 0 and row["trained"] == "False" for row in ours)
    assert all(float(row["peak_mib"]) > 0 and float(row["limit_ms"]) > 0 for row in ours)
    scored = list(csv.DictReader((tmp_path / "scores.csv").read_text().splitlines()))
    assert {row["network"] for row in scored} == {"highpass"} and len(scored) == 2
    assert "ours (no weights)" in (tmp_path / "chart.md").read_text()


def test_a_post_processor_is_scored_and_paid_for(tmp_path):
    torch.manual_seed(0)
    file = tmp_path / "restorer.safetensors"
    spec = {"target": "baselines.mambatm.MambaTM", "kwargs": {}}
    save(file, MambaTM(), spec, {})
    behind = HIGHPASS.replace("views: 1", f"views: 1, restorer: {file}")
    chart(tiny(tmp_path, f"+networks={{plain: {HIGHPASS}, behind: {behind}}}", "forms=[float32]"))
    speeds = list(csv.DictReader((tmp_path / "speed.csv").read_text().splitlines()))
    cost = {row["network"]: row for row in speeds}
    for what in ("ms", "gmac", "params"):
        assert float(cost["behind"][what]) > float(cost["plain"][what])
    scored = list(csv.DictReader((tmp_path / "scores.csv").read_text().splitlines()))
    assert {row["network"] for row in scored} == {"plain", "behind"}


def test_the_adaptive_network_is_shown_on_air_that_rises_and_falls(tmp_path):
    torch.manual_seed(0)
    network, file = SetNet(half=4), tmp_path / "tiny.safetensors"
    spec = {"target": "src.models.setnet.SetNet", "kwargs": {"half": 4}}
    save(file, network, spec, {})
    levels = f"adapt.levels=[[{file},1],[{file},9]]"
    small = [
        "adapt.course=[0,4,0]",
        "adapt.windows=18",
        "adapt.patience=2",
        "adapt.clips=2",
        "clips=1",
    ]
    chart(tiny(tmp_path, f"+networks={{highpass: {HIGHPASS}}}", levels, *small))
    assert all((tmp_path / f"adapt.{suffix}").is_file() for suffix in ("png", "svg", "csv"))
    lines = list(csv.DictReader((tmp_path / "adapt.csv").read_text().splitlines()))
    assert {line["run"] for line in lines} == {"adaptive", "always the least", "always the most"}
    assert {line["clip"] for line in lines} == {"0", "1"}
    assert "| always the most |" in (tmp_path / "chart.md").read_text()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sizes=[30]", "sizes must be multiples of 8"),
        ("forms=[int8]", "forms must be of float32"),
        ("threads=[0]", "threads must be numbers >= 1"),
        ("adapt.clips=0", "adapt.clips must be >= 1"),
        ("devices=[tpu]", "devices must be of cpu, cuda"),
        ("severities=[]", "severities must be of"),
        ("clips=0", "clips must be >= 1"),
    ],
)
def test_what_cannot_be_measured_is_named(tmp_path, override, message):
    with pytest.raises(ValueError, match=message):
        chart(tiny(tmp_path, "+networks={}", override))
