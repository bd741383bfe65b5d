"""Networks on disk: what is saved comes back; what is wrong is named; nothing is executed."""

import inspect
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from src.models import files
from src.models.e2vid import E2VID
from src.models.files import load, save
from src.models.network import unroll

KWARGS = {"views": 2, "bins": 3, "base_channels": 4, "spectral_norm": True}
SPEC = {"target": "src.models.e2vid.E2VID", "kwargs": KWARGS}


def trained() -> E2VID:
    torch.manual_seed(0)
    network = E2VID(**KWARGS)
    unroll(network, voxels())  # a power iteration, so that its vectors are not those of the start
    return network.eval()


def voxels() -> torch.Tensor:
    return torch.randn(1, 3, 2, 3, 16, 16, generator=torch.Generator().manual_seed(1))


@torch.no_grad()
def test_saved_weights_come_back_folded_and_rounded_to_half(tmp_path):
    network, path = trained(), tmp_path / "net.safetensors"
    save(path, network, SPEC, {"steps": 3})
    found = load(path)
    assert not found.training and found.views == 2
    assert all(p.dtype == torch.float32 for p in found.parameters())
    assert torch.allclose(unroll(found, voxels())[0], unroll(network, voxels())[0], atol=2e-3)
    assert not list(tmp_path.glob("*.partial"))


@torch.no_grad()
def test_a_training_checkpoint_loads_exactly(tmp_path):
    network, path = trained(), tmp_path / "last.ckpt"
    state = {f"network.{name}": value for name, value in network.state_dict().items()}
    torch.save({"network": SPEC, "state_dict": state}, path)
    assert torch.allclose(unroll(load(path), voxels())[0], unroll(network, voxels())[0], atol=1e-6)


@pytest.mark.parametrize("name", ["net.safetensors", "last.ckpt"])
def test_loading_leaves_the_random_numbers_as_they_are(tmp_path, name):
    network, path = trained(), tmp_path / name
    if path.suffix == ".ckpt":
        state = {f"network.{name}": value for name, value in network.state_dict().items()}
        torch.save({"network": SPEC, "state_dict": state}, path)
    else:
        save(path, network, SPEC, {})
    before = torch.get_rng_state()
    load(path)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_word_names_shipped_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WEIGHTS", tmp_path)
    save(tmp_path / "mine.safetensors", trained(), SPEC, {})
    assert isinstance(load("mine"), E2VID)
    with pytest.raises(ValueError, match=r"weights/ \(mine\), got other"):
        load("other")


def test_a_shipped_name_comes_before_a_file_or_folder_of_that_name(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WEIGHTS", tmp_path / "weights")
    (tmp_path / "weights" / "clean").mkdir(parents=True)
    for name in ("mine", "clean/mine"):
        save(tmp_path / f"weights/{name}.safetensors", trained(), SPEC, {})
    (tmp_path / "mine").mkdir()
    torch.save({"network": SPEC, "state_dict": trained().state_dict()}, tmp_path / "mine/last.ckpt")
    (tmp_path / "clean").mkdir()
    (tmp_path / "clean/mine").touch()
    monkeypatch.chdir(tmp_path)
    for name in ("mine", "clean/mine"):
        shipped = tmp_path / f"weights/{name}.safetensors"
        assert files.locate(name) == files.find_checkpoint(name, SPEC) == shipped
    for path in ("./mine", "mine/last.ckpt", "other", tmp_path / "weights/mine"):
        assert files.locate(path) == Path(path)
    assert files.find_checkpoint("./mine", SPEC) == Path("mine/last.ckpt")


@pytest.mark.parametrize("stem", [None, 6])
@torch.no_grad()
def test_one_view_is_where_many_begin(stem, tmp_path):
    torch.manual_seed(0)
    one = KWARGS | {"views": 1, "stem_channels": stem, "spectral_norm": False}
    path, narrow = tmp_path / "one.safetensors", E2VID(**one).eval()
    save(path, narrow, {"target": SPEC["target"], "kwargs": one}, {})
    nine = one | {"views": 9}
    assert files.find_checkpoint(path, {"target": SPEC["target"], "kwargs": nine}) == path
    wide = E2VID(**nine).eval()
    files.restore_weights(wide, path)
    seen = torch.randn(1, 3, 9, 3, 16, 16)
    ours, theirs = unroll(wide, seen)[0], unroll(load(path), seen[:, :, 4:5])[0]
    assert torch.allclose(ours, theirs, atol=1e-6)
    with pytest.raises(ValueError, match="ckpt must be of the network"):
        files.find_checkpoint(path, {"target": SPEC["target"], "kwargs": nine | {"bins": 4}})
    for other in ({"base_channels": 8}, {"bins": 4}, {"stem_channels": 7}, {"kernel_size": 3}):
        with pytest.raises(ValueError, match="ckpt does not fit E2VID"):
            files.restore_weights(E2VID(**nine | other), path)


def test_other_weights_are_listed(tmp_path):
    path, state = tmp_path / "last.ckpt", trained().state_dict()
    state = {f"network.{name}": value for name, value in state.items()}
    state["network.stranger"] = state.pop("network.pred.bias")
    torch.save({"network": SPEC, "state_dict": state}, path)
    with pytest.raises(ValueError, match=r"missing \['pred.bias'\], extra \['stranger'\]"):
        load(path)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "src.app.build.build_untrained_network",
        "src.models.files.save",
        "src.models.absent.X",
        "baselines.",
    ],
)
def test_only_our_networks_are_built(target, tmp_path):
    path = tmp_path / "last.ckpt"
    torch.save({"network": {"target": target, "kwargs": {}}, "state_dict": {}}, path)
    with pytest.raises(ValueError, match="ckpt"):
        load(path)


class Bomb:
    def __reduce__(self):
        return (exec, ("raise SystemExit('executed')",))


def test_nothing_is_executed(tmp_path):
    path = tmp_path / "bomb.ckpt"
    torch.save({"network": SPEC, "state_dict": Bomb()}, path)
    with pytest.raises(ValueError, match="ckpt must be a checkpoint"):
        load(path)


@pytest.mark.parametrize("suffix", [".ckpt", ".safetensors"])
def test_files_that_are_no_networks(suffix, tmp_path):
    path = tmp_path / f"x{suffix}"
    for content in (b"", b"hello", b"\x00" * 100):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="ckpt must be"):
            load(path)
    save_file({"a": torch.zeros(1)}, tmp_path / "plain.safetensors")
    with pytest.raises(ValueError, match="ckpt must be a network written by"):
        load(tmp_path / "plain.safetensors")


def test_what_is_no_path_is_refused():
    with pytest.raises(ValueError, match="ckpt must be a file or one of weights/ .*, got None"):
        inspect.unwrap(load)(None)  # without the type checks of tests


def test_a_path_is_read_where_the_shipped_weights_may_not_be(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(13, "Permission denied", "weights")

    save(tmp_path / "mine.safetensors", trained(), SPEC, {})
    monkeypatch.setattr(Path, "rglob", refuse)
    assert isinstance(load(tmp_path / "mine.safetensors"), torch.nn.Module)
