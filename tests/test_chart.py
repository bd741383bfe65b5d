"""src.chart at a tiny size: figures, tables, and rows without weights."""

import csv

import pytest
import torch

from baselines.mambatm import MambaTM
from src.app.compared_networks import load_candidates
from src.chart import draw_speed_accuracy_chart
from src.figures import frontier
from src.models.e2vid import E2VID
from src.models.files import save
from tests.test_train import config

HIGHPASS = "{baseline: {_target_: baselines.highpass.HighPass}, views: 1}"
SETNET = "{views: 9, model: {_target_: src.models.setnet.SetNet, channels: 4}}"
TINY = ["clips=2", "scene.height=64", "scene.width=64", "data.test_crop=32", "data.test_windows=4"]
TINY += [
    "data.unscored_windows=1",
    "metrics.lpips=null",
    "sizes=[32]",
    "seconds=0.01",
    "threads=[1]",
]
TINY += ["severities=[weak]", "forms=[float32,bf16]"]


def tiny(tmp_path, *overrides: str):
    return config("chart", tmp_path, "~networks", *TINY, *overrides)


def test_figures_and_tables_are_written_and_untrained_networks_timed_only(tmp_path):
    found = draw_speed_accuracy_chart(
        tiny(tmp_path, f"+networks={{highpass: {HIGHPASS}, ours: {SETNET}}}")
    )
    assert found == {"weak": "highpass"}
    for name in ("chart.png", "chart.svg", "chart.md"):
        assert (tmp_path / name).is_file()
    speeds = list(csv.DictReader((tmp_path / "speed.csv").read_text().splitlines()))
    ours = [row for row in speeds if row["network"] == "ours"]
    assert {row["form"] for row in ours} == {"float32", "bf16"}
    assert all(float(row["ms"]) > 0 and row["trained"] == "False" for row in ours)
    scored = list(csv.DictReader((tmp_path / "scores.csv").read_text().splitlines()))
    assert {row["network"] for row in scored} == {"highpass"} and len(scored) == 2
    assert "ours (no weights)" in (tmp_path / "chart.md").read_text()


def test_a_post_processor_is_scored_and_paid_for(tmp_path, monkeypatch):
    monkeypatch.setattr(frontier, "draw_accuracy_against_time", lambda *_, **__: None)
    torch.manual_seed(0)
    file = tmp_path / "restorer.safetensors"
    spec = {"target": "baselines.mambatm.MambaTM", "kwargs": {}}
    save(file, MambaTM(), spec, {})
    behind = HIGHPASS.replace("views: 1", f"views: 1, postprocessor: {file}")
    draw_speed_accuracy_chart(
        tiny(
            tmp_path,
            f"+networks={{plain: {HIGHPASS}, behind: {behind}}}",
            "forms=[float32]",
            "clips=1",
        )
    )
    speeds = list(csv.DictReader((tmp_path / "speed.csv").read_text().splitlines()))
    cost = {row["network"]: row for row in speeds}
    for what in ("ms", "gmac", "params"):
        assert float(cost["behind"][what]) > float(cost["plain"][what])
    scored = list(csv.DictReader((tmp_path / "scores.csv").read_text().splitlines()))
    assert {row["network"] for row in scored} == {"plain", "behind"}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("sizes=[30]", r"sizes must be multiples of 8 in 16\.\.4096, got 30"),
        ("sizes=[[1,2]]", r"sizes must be multiples of 8 in 16\.\.4096, got \[1, 2\]"),
        ("sizes=[100000000000]", r"sizes must be multiples of 8 in 16\.\.4096, got 1"),
        ("forms=[int8]", "forms must be of float32"),
        ("threads=[0]", "threads must be whole numbers >= 1"),
        ("threads=[1,1.5]", r"threads must be whole numbers >= 1, got 1, 1\.5"),
        ("devices=[tpu]", "devices must be of cpu, cuda"),
        ("severities=[]", "severities must be of"),
        ("clips=0", "clips must be >= 1"),
        ("seconds=-1", "seconds must be > 0, got -1"),
        ("threads=[2]", "threads must include 1, got 2"),
        ("devices=[cuda]", "devices must include cpu, got cuda"),
        ("data.test_windows=2", "data.unscored_windows must be in 0..0"),
    ],
)
def test_what_cannot_be_measured_is_named(tmp_path, override, message):
    with pytest.raises(ValueError, match=message):
        draw_speed_accuracy_chart(tiny(tmp_path, "+networks={}", override))
    assert not list(tmp_path.iterdir())


def test_other_bins_than_a_network_has_are_refused_before_the_timing(tmp_path):
    with pytest.raises(ValueError, match="bins must be 5 for setnet_small, got 3"):
        draw_speed_accuracy_chart(tiny(tmp_path, "+networks={}", "ckpt=[setnet_small]", "bins=3"))
    assert not list(tmp_path.iterdir())


def test_clips_that_cannot_be_simulated_are_refused_before_the_timing(tmp_path):
    with pytest.raises(ValueError, match=r"fps must be in \[0.001, 1e6\] windows .*, got nan"):
        draw_speed_accuracy_chart(tiny(tmp_path, f"+networks={{highpass: {HIGHPASS}}}", "fps=nan"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("found", [True, False])
def test_published_networks_without_their_weights_are_timed_only(tmp_path, request, found):
    names = ["firenet", "firenet_plus", "pienet", "pienet_lite", "cista"]
    folder = request.getfixturevalue("shared_data") / "weights" if found else tmp_path
    cfg = config("chart", tmp_path, f"paths.published={folder}")
    cfg.networks = {name: cfg.networks[name] for name in names}
    made = load_candidates(cfg)
    assert [one.name for one in made] == names
    assert all(one.trained == found and one.network is not None for one in made)
    sizes = {one.name: sum(p.numel() for p in one.loaded.parameters()) for one in made}
    assert (sizes["pienet"], sizes["pienet_lite"]) == (171_121, 78_537)


def test_files_of_one_name_are_networks_of_their_own(tmp_path):
    for name, width in (("a", 4), ("b", 8)):
        kwargs = {"views": 1, "base_channels": width}
        (tmp_path / name).mkdir()
        spec = {"target": "src.models.e2vid.E2VID", "kwargs": kwargs}
        save(tmp_path / name / "net.safetensors", E2VID(**kwargs), spec, {})
    files = [f"{tmp_path}/{name}/net.safetensors" for name in "ab"]
    found = load_candidates(tiny(tmp_path, "+networks={}", f"ckpt=[{','.join(files)}]"))
    assert [candidate.name for candidate in found] == files
    (one,) = load_candidates(tiny(tmp_path, "+networks={}", f"ckpt=[{files[0]}]"))
    assert one.name == "net"
