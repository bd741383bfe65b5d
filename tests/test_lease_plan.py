"""The plan of a time-limited training: refused where it cannot be, with the numbers."""

import sys
import time
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from omegaconf import OmegaConf

from scripts.lease import __main__ as lease
from scripts.lease import plan as plans
from scripts.lease.fit import Sized, allotted, choose, excess, fit, sized
from scripts.lease.plan import Network
from scripts.lease.training import HoursAnew, InTime
from src.app import build
from src.models import files
from src.sim.scenes.photo_pack import Picture, packed
from src.training.schedule import Hours
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
        pictures.append(Picture(f"{split}.png", split, data, image.shape))
    path.write_bytes(packed(pictures))
    return path


def begun(path: Path, hours: float) -> Path:
    """Exported weights of a training of so many hours and five steps."""
    network = plans.load(DRY).networks[1]
    row = {"hours": hours, "steps": 5, "windows": 40, "loss": 0.5}
    card = row | {"curve": [row]}
    files.save(path, *build.network(plans.load(DRY).config(network)), card)
    return path


@pytest.fixture(scope="module")
def three() -> list[Sized]:
    found = plans.load(DRY)
    return [sized(found, network) for network in found.networks]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"margin_s": 170}, r"minutes must be >= 3.\d\d: 0.12 of training .*margin 170 s\), got 3"),
        ({"budget_mib": 1}, r"budget_mib must be >= 1.15 \(lf3x3 0.45, single256 0.45\), got 1"),
        ({"files": 5}, r"files must be >= 6 \(lf3x3 2, single256 2, curves.*json\), got 5"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_numbers(changes, said, three, tmp_path):
    assert not excess(plans.load(DRY), three[:2], 3)
    with pytest.raises(ValueError, match=f"^{said}"):
        choose(plans.load(plan(tmp_path, **changes)), three, 3)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"marginals": 3}, "keys must be of .*; unknown marginals"),
        ({"fill": {"minutes": 1}}, "fill: keys must be of .*; missing clips"),
        ({"fill": {"minutes": 1, "clips": 8, "least": 9}}, "fill: clips must be .* >= 9, got 8"),
        ({"check_s": -1}, "check_s must be a number > 0, got -1"),
        ({"scenes": "no.pack"}, "scenes must be a file, got no.pack, which is not in"),
        ({"networks": []}, "networks must have names of their own"),
        ({"networks": None}, "networks are missing"),
        ({"networks": [{"name": "a/b", "minutes": 1}]}, "name must be letters, digits"),
        ({"networks": [{"name": "lf3x3"}]}, "minutes of lf3x3 must be > 0"),
        ({"networks": [{"name": "lf3x3", "minutes": 1, "many": 2}]}, "networks: .*unknown many"),
        ({"networks": [{"name": "single256", "minutes": 0.1, "start": "x.ckpt"}]}, "exported"),
    ],
)
def test_a_file_that_is_no_plan_is_refused(changes, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        plans.load(plan(tmp_path, **changes))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"file_mib": 0.1}, "file_mib must be >= 0.20 for lf3x3, one tensor of which has 0.14 MiB"),
        ({"networks": [{"name": "nowhere", "minutes": 1}]}, "networks: nowhere cannot be trained"),
        ({"common": ["budget=lease", "trainer=cpu", "loss=l1", "width=0"]}, "lf3x3 cannot be"),
    ],
)
def test_a_network_that_cannot_be_trained_is_refused(changes, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        fit(plans.load(plan(tmp_path, **changes)), 3)


def test_a_damaged_pack_and_a_rate_at_its_end_are_refused(tmp_path):
    whole = pack(tmp_path / "photos.pack").read_bytes()
    (tmp_path / "photos.pack").write_bytes(whole[:-40] + bytes(8) + whole[-32:])
    with pytest.raises(ValueError, match=r"photos.pack is damaged: the SHA-256 of \w+.png"):
        plans.load(plan(tmp_path, scenes="photos.pack"))
    begun(tmp_path / "begun.safetensors", 8)
    row = {"name": "single256", "minutes": 4, "start": "begun.safetensors"}
    with pytest.raises(ValueError, match="after 8.00 h a cosine of 4 minutes more begins at 0.02%"):
        plans.load(plan(tmp_path, networks=[row]))
    plans.load(plan(tmp_path, networks=[row | {"restart": True}]))


def test_what_is_optional_comes_only_where_it_fits(three, tmp_path):
    found = plans.load(DRY)
    two, all_of_them = choose(found, three, 3), choose(found, three, 9)
    assert list(two.left_out) == ["single768"] and two.doubled == {"lf3x3", "single256"}
    assert all_of_them.networks == three and not all_of_them.left_out
    assert not all_of_them.doubled, "eight files are all there may be"
    small = choose(plans.load(plan(tmp_path, budget_mib=1.3)), three, 9)
    assert "budget_mib must be >= 1.5" in small.left_out["single768"] and not small.doubled
    large = choose(plans.load(plan(tmp_path, budget_mib=9, file_mib=3, files=10)), three, 3)
    assert large.doubled == two.doubled and large.checkpoints == {"lf3x3", "single256"}
    with pytest.raises(ValueError, match="none fits: minutes must be"):
        choose(found, three[2:], 3)
    with pytest.raises(ValueError, match="only must be of lf3x3, single256, single768, got two"):
        found.only(["two"])


def test_what_a_lease_would_do_is_told_without_one(capsys):
    assert lease._done(["check", DRY], {"only": "single256"}, 3) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "0.50 of 3 minutes are check, cache, validation and margin"
    assert second.startswith(
        "single256: 0.06 min, 168,177 parameters, 0.45 MiB in 2 files; its last"
    )


def test_minutes_left_over_go_by_shares_and_missing_ones_shorten_all():
    pair = [Network("a", minutes=1, share=1), Network("b", minutes=2, share=3)]
    assert allotted(pair, 220) == [70, 150] and allotted(pair, 90) == [30, 60]


def test_the_rate_ends_with_the_time_there_is():
    hours, clock = Hours(hours=1.0), SimpleNamespace(hours=0.25)
    module, curve = SimpleNamespace(clock=clock), SimpleNamespace(scoring_s=4.0)
    in_time = InTime(hours, curve, time.monotonic() + 366)
    in_time.on_train_batch_start(None, module, None, 0)
    assert hours.hours == pytest.approx(0.35, abs=1e-3), "of 366 s 6 are kept for the scoring"
    anew = HoursAnew(8.0, hours=8.5)
    assert anew.share(8.0) == 1 and anew.share(8.25) == pytest.approx(0.5) and anew.share(9) == 0


def test_missing_packages_are_named_before_anything_else(monkeypatch, capsys):
    monkeypatch.setitem(lease.NEEDED, "nowhere_to_be_found", "some-package")
    monkeypatch.setattr(sys, "argv", ["lease", "/nowhere.yaml", "--minutes", "1"])
    with pytest.raises(SystemExit, match="missing packages: nowhere_to_be_found; pip install some"):
        lease.main()


@pytest.mark.parametrize(
    "words",
    [
        "", "plan.yaml", "plan.yaml --minutes", "plan.yaml --minutes many", "join", "join a b",
        "plan.yaml --minutes 3 to=a", "folder a plan.yaml --minutes 3", "check plan.yaml",
    ],
)  # fmt: skip
def test_a_wrong_command_line_ends_with_how_it_is_used(words):
    with pytest.raises(SystemExit, match="python -m scripts.lease PLAN --minutes N"):
        lease._parsed(words.split())
