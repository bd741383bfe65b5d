"""The plan of a time-limited training: refused where it cannot be, with the numbers."""

import time
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import cv2
import numpy as np
import pytest
from lightning import Trainer
from omegaconf import OmegaConf

from scripts.lease import __main__ as lease
from scripts.lease import plan as plans
from scripts.lease.folder import gather_files
from scripts.lease.plan import Network
from scripts.lease.run import Lease
from scripts.lease.selection import (
    SizedNetwork,
    allot_seconds,
    find_excess,
    select_networks,
    size_network,
)
from scripts.lease.training import DeadlineSchedule, ExportingCurve
from scripts.pack_scenes import EncodedPicture, build_pack
from src.app import build
from src.losses.terms import L1Term, TrainingLoss
from src.models import files
from src.training.learning_curve import LearningCurve
from tests.conftest import ROOT

DRY = ROOT / "conf" / "lease" / "dry.yaml"


def plan(folder: Path, **changes) -> Path:
    """A plan as conf/lease/dry.yaml with other values; None takes a key away."""
    content = OmegaConf.to_container(OmegaConf.load(DRY)) | changes
    path = folder / "dry.yaml"
    folder.mkdir(exist_ok=True)
    kept = {key: value for key, value in content.items() if value is not None}
    path.write_text(OmegaConf.to_yaml(OmegaConf.create(kept)))
    return path


def pack(path: Path) -> Path:
    rng, pictures = np.random.default_rng(0), []
    for split in ("train", "val"):
        image = cv2.GaussianBlur(rng.uniform(0, 1, (120, 160)), (0, 0), 4)
        image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        data = cv2.imencode(".png", image)[1].tobytes()
        pictures.append(EncodedPicture(f"{split}.png", split, data, image.shape))
    path.write_bytes(build_pack(pictures))
    return path


def begun(path: Path, hours: float) -> Path:
    """Exported weights of a training of so many hours and five steps."""
    network = plans.load_plan(DRY).networks[1]
    row = {"hours": hours, "steps": 5, "windows": 40, "loss": 0.5}
    card = row | {"curve": [row]}
    files.save(path, *build.build_untrained_network(plans.load_plan(DRY).config(network)), card)
    return path


@pytest.fixture(scope="module")
def three() -> list[SizedNetwork]:
    found = plans.load_plan(DRY)
    return [size_network(found, network) for network in found.networks]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"margin_s": 170}, r"minutes must be >= 3.\d\d: 0.12 of training .*margin 170 s\), got 3"),
        (
            {"max_export_total_mib": 1},
            r"max_export_total_mib must be >= 1.15 \(lf3x3 0.45, single256 0.45\), got 1",
        ),
        (
            {"max_export_files": 5},
            r"max_export_files must be >= 6 \(lf3x3 2, single256 2, curves.*json\), got 5",
        ),
    ],
)
def test_what_does_not_fit_is_refused_with_the_numbers(changes, said, three, tmp_path):
    assert not find_excess(plans.load_plan(DRY), three[:2], 3)
    with pytest.raises(ValueError, match=f"^{said}"):
        select_networks(plans.load_plan(plan(tmp_path, **changes)), three, 3)


def test_a_network_starts_from_shipped_weights_by_name(tmp_path):
    one = {"name": "setnet_small", "minutes": 0.1, "start": "setnet_small"}
    found = plans.load_plan(plan(tmp_path, networks=[one]))
    assert found.earlier_hours(found.networks[0]) > 10


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"marginals": 3}, "Key .marginals. not in .Plan."),
        ({"files": 3}, "^lease.files is now lease.max_export_files$"),
        ({"fill": {"minutes": 1}}, "missing value: fill.clips|missing.*clips"),
        (
            {"fill": {"minutes": 1, "clips": 8, "warn_below_clips": 9}},
            "fill: clips must be >= 9, got 8",
        ),
        ({"check_s": -1}, "check_s must be > 0, got -1"),
        ({"scenes": "no.pack"}, "scenes must be a file, got no.pack, which is not in"),
        ({"networks": []}, "networks must have names of their own"),
        ({"networks": None}, "missing.*networks"),
        ({"networks": [{"name": "a/b", "minutes": 1}]}, "name must be letters, digits"),
        ({"networks": [{"name": "lf3x3"}]}, "minutes of lf3x3 must be > 0"),
        ({"networks": [{"name": "lf3x3", "minutes": 1, "many": 2}]}, "Key .many. not in .Network."),
        ({"networks": [{"name": "single256", "minutes": 0.1, "start": "x.ckpt"}]}, "exported"),
    ],
)
def test_a_file_that_is_no_plan_is_refused(changes, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        plans.load_plan(plan(tmp_path, **changes))


@pytest.mark.parametrize("text", ["networks: [", "- a", "fill: \t- 1"])
def test_yaml_that_is_none_is_refused_in_one_line(text, tmp_path):
    path = tmp_path / "plan.yaml"
    path.write_text(text)
    for read in (plans.load_plan, lambda file: gather_files(tmp_path / "all", file, {})):
        with pytest.raises(ValueError, match="plan.yaml must be as conf/lease/default.yaml is"):
            read(path)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"max_export_file_mib": 0.1},
            "max_export_file_mib must be >= 0.20 for lf3x3, one tensor of which has 0.14 MiB",
        ),
        ({"networks": [{"name": "nowhere", "minutes": 1}]}, "networks: nowhere cannot be trained"),
        ({"common": ["budget=lease", "trainer=cpu", "loss=l1", "width=0"]}, "lf3x3 cannot be"),
    ],
)
def test_a_network_that_cannot_be_trained_is_refused(changes, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        found = plans.load_plan(plan(tmp_path, **changes))
        [size_network(found, network) for network in found.networks]


@pytest.mark.parametrize(
    ("ended", "code", "said"),
    [
        (["a", "b", "c"], 0, "trained: a, b, c; in out"),
        (["a", "b"], 0, "trained: a, b, c; in out"),
        (["a", "c"], 1, "trained: a, b, c; unfinished: b; in out"),
    ],
)
def test_the_exit_code_tells_whether_what_is_not_optional_was_trained(ended, code, said):
    networks = [SimpleNamespace(name=name, network=Network(name, minutes=1)) for name in "abc"]
    networks[2].network.optional = True
    lines: list[str] = []
    lease = SimpleNamespace(
        selection=SimpleNamespace(networks=networks), log=lines.append,
        exports=SimpleNamespace(out="out"),
        networks={name: {"trained": 3, "finished": name in ended} for name in "abc"},
    )  # fmt: skip
    assert Lease._exit_code(lease) == code and lines == [said]


def test_a_damaged_pack_is_refused(tmp_path):
    whole = pack(tmp_path / "photos.pack").read_bytes()
    (tmp_path / "photos.pack").write_bytes(whole[:-40] + bytes(8) + whole[-32:])
    with pytest.raises(ValueError, match=r"photos.pack is damaged: the SHA-256 of \w+.png"):
        plans.load_plan(plan(tmp_path, scenes="photos.pack"))


def test_what_is_optional_comes_only_where_it_fits(three, tmp_path):
    found = plans.load_plan(DRY)
    two, all_of_them = select_networks(found, three, 3), select_networks(found, three, 9)
    assert list(two.left_out) == ["single768"] and two.networks == three[:2]
    assert all_of_them.networks == three and not all_of_them.left_out
    small = select_networks(plans.load_plan(plan(tmp_path, max_export_total_mib=1.3)), three, 9)
    assert "max_export_total_mib must be >= 1.5" in small.left_out["single768"]
    with pytest.raises(ValueError, match="none fits: minutes must be"):
        select_networks(found, three[2:], 3)
    with pytest.raises(ValueError, match="only must be of lf3x3, single256, single768, got two"):
        found.select(["two"])


def test_what_a_lease_would_do_is_told_without_one(capsys):
    assert lease.run_command(["check", DRY], {"only": "single256"}, 3) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "0.50 of 3 minutes are check, cache, validation and margin"
    assert second == "single256: 0.06 min, 168,177 parameters, 0.45 MiB in 2 files"


def test_minutes_left_over_go_by_shares_and_missing_ones_shorten_all():
    pair = [Network(name="a", minutes=1, share=1), Network(name="b", minutes=2, share=3)]
    assert allot_seconds(pair, 220) == [70, 150] and allot_seconds(pair, 90) == [30, 60]


def test_a_curve_knows_how_long_its_last_scoring_took(tmp_path, monkeypatch):
    monkeypatch.setattr(LearningCurve, "score_and_export", lambda *_: time.sleep(0.05))
    curve = ExportingCurve(tmp_path / "a.safetensors", 0.1, 60, print)
    curve.on_train_start(
        Mock(spec=Trainer, is_global_zero=True),
        SimpleNamespace(loss=TrainingLoss({"l1": L1Term()})),
    )
    assert curve.scoring_s >= 0.05


def test_the_rate_ends_with_the_time_there_is():
    options = {"curve": SimpleNamespace(scoring_s=4.0), "deadline": time.monotonic() + 366}
    schedule = DeadlineSchedule(0.0, train_hours=1.0, **options)
    schedule.limit_train_hours(0.25)
    assert schedule.train_hours == pytest.approx(0.35, abs=1e-3), "366 s less 6 for the scoring"
    restarted = DeadlineSchedule(8.0, train_hours=8.5, **options)
    ratios = [restarted.lr_ratio(hours) for hours in (8.0, 8.25, 9.0)]
    assert ratios == pytest.approx([1, 0.5, 0])


@pytest.mark.parametrize(
    "words",
    [
        "", "plan.yaml", "plan.yaml --minutes", "plan.yaml --minutes many", "join", "join a b",
        "plan.yaml --minutes 3 to=a", "folder a plan.yaml --minutes 3", "check plan.yaml",
    ],
)  # fmt: skip
def test_a_wrong_command_line_ends_with_how_it_is_used(words, capsys):
    with pytest.raises(SystemExit, match="2"):
        lease.parse(words.split())
    assert "usage: python -m scripts.lease" in capsys.readouterr().err
