"""A training begins as the weights that `start` names, and is compared with `references`."""

import re

import pytest
import torch
from torch.nn.utils import parametrize

from src.app import build, entry_point, start_weights
from src.models import files
from src.models.e2vid import E2VID
from src.models.files import load
from src.models.network import unroll
from src.train import train
from tests.test_train import TINY, config

ONE_VIEW = {"views": 1, "bins": 5, "base_channels": 4, "stem_channels": 6, "spectral_norm": False}
SPEC = {"target": "src.models.e2vid.E2VID", "kwargs": ONE_VIEW}


def write_weights(path, **other):
    torch.manual_seed(0)
    kwargs = ONE_VIEW | other
    files.save(path, E2VID(**kwargs), SPEC | {"kwargs": kwargs}, {})
    return path


@torch.no_grad()
def test_nine_views_begin_exactly_as_the_shipped_network_on_one(tmp_path):
    cfg = config("train", tmp_path, "budget=fine_tuning", "model.spectral_norm=false")
    assert (cfg.start, cfg.width) == ("single256", 8)  # the width is that of the weights
    path = start_weights.set_model_from_start_weights(cfg)
    net, spec = build.build_untrained_network(cfg)
    files.restore_weights(net, path)
    one_view = files.read_network_spec(path)
    assert spec == one_view | {"kwargs": one_view["kwargs"] | {"views": 9}}
    # In float64: a sum over 45 channels and one over 5 may differ in the last digit.
    seen = torch.randn(1, 4, 9, 5, 32, 32, dtype=torch.float64)
    ours = unroll(net.eval().double(), seen)[0]
    theirs = unroll(load("single256").double(), seen[:, :, 4:5])[0]
    assert torch.allclose(ours, theirs, rtol=0, atol=1e-9) and ours.std() > 0.01
    name = start_weights.label_before_training(cfg, path)
    assert name == "single256 given 9 views, before training"


@torch.no_grad()
def test_the_shipped_network_goes_on_with_its_spectral_norm(tmp_path):
    cfg = config("train", tmp_path, "budget=fine_tuning")
    path = start_weights.set_model_from_start_weights(cfg)
    net, spec = build.build_untrained_network(cfg)
    files.restore_weights(net, path)
    assert spec["kwargs"]["spectral_norm"] is True
    assert all(parametrize.is_parametrized(gate, "weight") for gate in net.gates)
    seen = torch.randn(1, 4, 9, 5, 32, 32)
    gap = unroll(net.eval(), seen)[0] - unroll(load("single256"), seen[:, :, 4:5])[0]
    assert gap.abs().max() < 5e-3  # norms of float16, up to 1.0005, are divided out


def test_gates_of_another_norm_are_trained_without_unless_it_is_typed(
    tmp_path, monkeypatch, capsys
):
    path = write_weights(tmp_path / "one.safetensors")
    cfg = config("train", tmp_path, f"start={path}")
    start_weights.set_model_from_start_weights(cfg)
    assert cfg.model.spectral_norm is False
    assert re.search(
        "start has gates of norm .*: model.spectral_norm=false", capsys.readouterr().err
    )
    cfg = type_command(monkeypatch, tmp_path, f"start={path}", "model.spectral_norm=true")
    start_weights.set_model_from_start_weights(cfg)
    assert cfg.model.spectral_norm is True


def type_command(monkeypatch, tmp_path, *overrides):
    typed = {"overrides": list(overrides)}
    monkeypatch.setattr(entry_point, "describe_hydra_command", lambda: typed)
    return config("train", tmp_path, *overrides)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["width=12"], "width must be 16, as in start=single256, got 12"),
        (["model.base_channels=12"], "model.base_channels must be 16, as in"),
        (["stem=null"], "stem must be 32, as in start=single256, got null"),
        (["state_rounding_step=0.5"], "state_rounding_step must be 0.25, as in .*, got 0.5"),
        (["model.recurrent=convgru"], "model.recurrent must be convlstm, as in .*, got convgru"),
        (
            ["experiment=setnet_small", "start=setnet_small", "model=setnet_large"],
            "model must have channels=16, .*as in start=setnet_small, got channels=64, ",
        ),
    ],
)
def test_a_typed_value_that_the_weights_do_not_have_is_refused(
    overrides, said, tmp_path, monkeypatch
):
    cfg = type_command(monkeypatch, tmp_path, "budget=fine_tuning", *overrides)
    with pytest.raises(ValueError, match=said):
        start_weights.set_model_from_start_weights(cfg)


def test_a_typed_value_that_the_weights_have_is_taken(tmp_path, monkeypatch):
    same = ["width=16", "stem=32", "model.recurrent=convlstm", "optics=lf3x3", "model=e2vid"]
    cfg = type_command(monkeypatch, tmp_path, "budget=fine_tuning", *same)
    assert start_weights.set_model_from_start_weights(cfg) == files.locate("single256")
    own = ["experiment=setnet_small", "start=setnet_small", "model.size=small"]
    cfg = type_command(monkeypatch, tmp_path, *own)
    assert start_weights.set_model_from_start_weights(cfg) == files.locate("setnet_small")


@pytest.mark.parametrize("start", ["none", "null"])
def test_without_a_start_the_network_is_that_of_the_config(start, tmp_path):
    cfg = config("train", tmp_path, "budget=fine_tuning", f"start={start}")
    assert start_weights.set_model_from_start_weights(cfg) is None
    assert build.build_untrained_network(cfg)[0].head.out_channels == cfg.width == 8
    assert start_weights.label_before_training(cfg, None) == "untrained"


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["start=nowhere"], r"start must be none, one of weights/ \(.*single256.*\) or a file"),
        (["start=setnet_small"], "start must be weights of src.models.e2vid.E2VID, got .*SetNet"),
        (["start=single256", "bins=3"], "start must be weights for bins=3, got 5"),
        (["start=lf3x3", "optics=lf2x2"], "start must be weights of 1 or 4 views, got 9"),
        (["start={tmp}/no.safetensors"], "start must be weights to begin from: ckpt must be"),
    ],
)
def test_a_wrong_start_is_one_line_that_names_it(overrides, said, tmp_path):
    (tmp_path / "no.safetensors").write_bytes(b"none")
    cfg = config("train", tmp_path, *(given.format(tmp=tmp_path) for given in overrides))
    with pytest.raises(ValueError, match=said):
        start_weights.set_model_from_start_weights(cfg)


def test_what_a_resumed_run_began_from_replaces_the_start_of_the_budget(tmp_path, monkeypatch):
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    (run / "config.yaml").write_text("start: setnet_small\n")
    (last := run / "checkpoints" / "last.ckpt").touch()
    resumed = ["experiment=setnet_small", "budget=fine_tuning"]
    for ckpt in (last, "setnet_small"):
        cfg = config("train", tmp_path, *resumed, f"ckpt={ckpt}")
        assert start_weights.set_model_from_start_weights(cfg) == files.locate("setnet_small")
        assert cfg.start == "setnet_small"  # as the table calls what it began as
    (run / "config.yaml").unlink()
    cfg = config("train", tmp_path, *resumed, f"ckpt={last}")
    assert start_weights.set_model_from_start_weights(cfg) is None
    typed = {"overrides": ["start=single256"]}
    monkeypatch.setattr(entry_point, "describe_hydra_command", lambda: typed)
    cfg = config("train", tmp_path, *resumed, f"ckpt={last}", "start=single256")
    with pytest.raises(ValueError, match="start must be weights of src.models.setnet.SetNet"):
        start_weights.set_model_from_start_weights(cfg)


def test_references_are_loaded_by_their_names_or_refused(tmp_path):
    path = write_weights(tmp_path / "two.safetensors", views=2)
    cfg = config("train", tmp_path, f"+references={{two: {path}, small: setnet_small}}")
    with pytest.warns(UserWarning, match="references.two is left out: it takes optics.views=2"):
        assert list(start_weights.load_reference_networks(cfg)) == ["small"]
    cfg.references = {"restorer": "mambatm"}
    with pytest.raises(ValueError, match="references.restorer must be a network for events"):
        start_weights.load_reference_networks(cfg)
    cfg.references = {"none": "nowhere"}
    with pytest.raises(ValueError, match="references.none must be a network: .*nowhere"):
        start_weights.load_reference_networks(cfg)


def test_a_training_from_weights_is_compared_with_its_beginning(tmp_path):
    path = write_weights(tmp_path / "one.safetensors")
    asked = [f"start={path}", f"+references.again={path}", "optics=single", "sample_clips=1"]
    record = train(config("train", tmp_path / "run", *TINY, *asked))
    names = [f"{path}, before training", "again", "high-pass, centre view"]
    assert list(record["compared"]) == names
    before, again = (record["compared"][name]["ssim"]["mean"] for name in names[:2])
    assert before == pytest.approx(again, abs=1e-5)  # `again` is what it began as
    assert record["test"]["ssim"]["mean"] != pytest.approx(before, abs=1e-5)
    samples = sorted(file.name for file in (tmp_path / "run" / "samples").iterdir())
    assert samples == ["clip0.gif", "clip0_slice.png"]
