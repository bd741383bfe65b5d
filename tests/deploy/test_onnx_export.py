"""ONNX with explicit state, and the running form: the same frames as the network itself."""

import copy
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from baselines.firenet import FireNet
from baselines.highpass import HighPass
from baselines.pienet import PIENet
from src.deploy import onnx_export
from src.deploy.forms import Bf16Network, convert_to_form
from src.deploy.onnx_export import OnnxNetwork, export_onnx
from src.models.e2vid import E2VID
from src.models.files import load
from src.models.network import EventToVideoNetwork
from src.models.setnet import SetNet

ROOT = Path(__file__).resolve().parents[2]
NETWORKS = {
    "e2vid": lambda: E2VID(views=9, base_channels=4, spectral_norm=True),
    "setnet": lambda: SetNet(channels=4),
    "firenet": FireNet,
}


def frames(network, windows, **told):
    state, shown = None, []
    with torch.no_grad():
        for window in windows:
            frame, state = network(window, state, **told)
            shown.append(frame)
    return torch.cat(shown)


def noise(windows: int = 3) -> torch.Tensor:
    torch.manual_seed(1)
    return torch.randn(windows, 1, 9, 5, 32, 32)


@pytest.mark.parametrize("name", ["e2vid", "setnet"])
def test_onnx_gives_the_frames_of_the_network_window_by_window(name, tmp_path):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    torch.manual_seed(0)
    network = NETWORKS[name]().eval()
    found = export_onnx(network, tmp_path / "net.onnx", views=9, height=32, width=32)
    torch.testing.assert_close(
        frames(found, noise()), frames(network, noise()), atol=1e-4, rtol=1e-3
    )
    assert isinstance(found, OnnxNetwork) and found.views == 9
    assert found.uses_window_length == network.uses_window_length
    with pytest.raises(
        ValueError, match=r"voxels must be float32 \[1, 9, 5, 32, 32\], as exported"
    ):
        found(noise()[0, :, :3])
    with pytest.raises(ValueError, match="path must be in a folder that is there"):
        export_onnx(network, tmp_path / "none" / "net.onnx", views=9, height=32, width=32)


def test_pienet_lite_is_exported(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    torch.manual_seed(0)
    network = PIENet(base_channels=12, channels=(16, 24), pools=(2, 2)).eval()
    found = export_onnx(network, tmp_path / "net.onnx", views=1, height=48, width=40)
    assert found.views == 1


def test_a_file_that_onnx_runtime_cannot_run_is_one_line(tmp_path, monkeypatch):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    monkeypatch.setattr(onnx_export, "_write", lambda *given: given[-1].write_bytes(b"none"))
    with pytest.raises(ValueError, match="FireNet has a part that ONNX Runtime cannot run"):
        export_onnx(FireNet(), tmp_path / "net.onnx", views=1, height=40, width=40)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", NETWORKS)
def test_the_running_form_is_as_accurate_as_its_type(name):
    torch.manual_seed(0)
    network = NETWORKS[name]().eval()
    plain = frames(network, noise())
    rounded = frames(Bf16Network(network), noise())
    assert rounded.dtype == torch.float32 and (rounded - plain).abs().mean() < 0.02


def compiled_gap(name: str) -> float:
    network = NETWORKS[name]().eval()
    forms = [frames(convert_to_form(network, form), noise()) for form in ("bf16", "compiled")]
    return float((forms[0] - forms[1]).abs().max())


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_the_compiled_form_gives_the_frames_of_bf16(name):
    """In a process of its own, where annotations are not checked: the checks do not compile."""
    code = f"from tests.deploy.test_onnx_export import compiled_gap; print(compiled_gap({name!r}))"
    line = [sys.executable, "-c", code]
    found = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True)
    assert float(found.stdout) < 0.02


@pytest.mark.parametrize(
    ("form", "network", "words"),
    [
        ("float16", E2VID(views=9, base_channels=4), "form must be one of float32, bf16, compiled"),
        (
            "bf16",
            HighPass(view_reduction="median"),
            "form must be float32 for a network without parameters",
        ),
    ],
)
def test_a_form_that_is_none_is_named(form, network, words):
    with pytest.raises(ValueError, match=words):
        convert_to_form(network, form)


def test_without_a_compiler_nothing_is_compiled(monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler")
    with pytest.raises(ValueError, match="form=compiled needs a C.. compiler"):
        convert_to_form(E2VID(views=9, base_channels=4), "compiled")


def test_what_onnx_cannot_express_is_said(tmp_path):
    pytest.importorskip("onnxscript")
    with pytest.raises(ValueError, match="HighPass has a part that ONNX cannot express"):
        export_onnx(
            HighPass(view_reduction="median"), tmp_path / "a.onnx", views=9, height=16, width=16
        )


def test_a_file_that_is_refused_leaves_the_one_before(tmp_path, monkeypatch):
    """Without the packages: the parts that need them are stand-ins."""
    monkeypatch.setattr(onnx_export, "require_onnx", lambda: None)
    monkeypatch.setattr(onnx_export, "_write", lambda *given: given[-1].write_bytes(b"refused"))
    monkeypatch.setattr(onnx_export, "OnnxNetwork", lambda path: NETWORKS["setnet"]())
    monkeypatch.setattr(onnx_export, "_largest_difference", lambda *given: 0.3)
    good, size = tmp_path / "good.onnx", {"views": 9, "height": 16, "width": 16}
    good.write_bytes(b"good")
    for path in (good, tmp_path / "new.onnx"):
        with pytest.raises(ValueError, match=r"frames and states within 0\.0001, got 0\.3"):
            export_onnx(NETWORKS["setnet"](), path, **size)
    assert [path.name for path in tmp_path.iterdir()] == ["good.onnx"]
    assert good.read_bytes() == b"good"
    monkeypatch.setattr(onnx_export, "_largest_difference", lambda *given: 0.0)
    export_onnx(NETWORKS["setnet"](), good, **size)
    assert good.read_bytes() == b"refused"


def test_a_shipped_network_that_rounds_its_state_is_exported(tmp_path):
    pytest.importorskip("onnxruntime", reason="needs the extra onnx")
    pytest.importorskip("onnxscript", reason="needs the extra onnx")
    found = export_onnx(load("lf3x3"), tmp_path / "net.onnx", views=9, height=128, width=128)
    assert found.views == 9


class Converted(EventToVideoNetwork):
    """A stand-in for an exported file: `network` with its state a list of arrays, `change`d."""

    def __init__(self, network, change=lambda state: state):
        super().__init__()
        self.network, self.change = network, change

    def forward(self, window, state=None):
        tensors = [torch.from_numpy(part) for part in state or []]
        pairs = list(zip(tensors[::2], tensors[1::2], strict=True))
        frame, after = self.network(window, pairs or None)
        return frame, self.change([part.numpy() for pair in after for part in pair])


@pytest.fixture(scope="module")
def rounding():
    network = load("single256").eval()
    assert network.state_rounding_step == 0.25
    return network


def checked(exported, network) -> float:
    window = torch.randn(1, 1, 5, 128, 128, generator=torch.Generator().manual_seed(0))
    return onnx_export._largest_difference(exported, network, window, None)


@torch.no_grad()
def test_a_rounding_step_that_a_last_bit_turns_is_no_difference(rounding):
    def move(state):
        return [part + np.float32(1e-5) for part in state]

    window = torch.randn(1, 1, 5, 128, 128, generator=torch.Generator().manual_seed(0))
    _, state = rounding(window)
    moved = [(hidden + 1e-5, memory + 1e-5) for hidden, memory in state]
    turned = rounding(window, moved)[0] - rounding(window, state)[0]
    assert turned.abs().max() > onnx_export.TOLERANCE
    assert checked(Converted(rounding, move), rounding) <= 1.1e-5


def test_a_conversion_without_the_rounding_or_with_another_state_is_refused(rounding):
    unrounded = copy.deepcopy(rounding)
    unrounded.state_rounding_step = None
    assert checked(Converted(unrounded), rounding) > 10 * onnx_export.TOLERANCE
    for change in (
        lambda state: [*state[:-1], state[-1] + np.float32(2e-4)],
        lambda state: [state[1], state[0], *state[2:]],
        lambda state: [state[0] * np.nan, *state[1:]],
    ):
        assert not checked(Converted(rounding, change), rounding) <= onnx_export.TOLERANCE


@pytest.mark.parametrize(("height", "width"), [(1, 16), (16, 4)])
def test_sides_that_a_runtime_refuses_are_not_exported(height, width, tmp_path, monkeypatch):
    monkeypatch.setattr(onnx_export, "require_onnx", lambda: None)
    size = {"views": 9, "height": height, "width": width}
    with pytest.raises(ValueError, match=f">= 8 px.*, got {height} and {width}"):
        export_onnx(NETWORKS["setnet"](), tmp_path / "a.onnx", **size)
