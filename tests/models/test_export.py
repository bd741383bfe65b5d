"""ONNX with explicit state, and the running form: the same frames as the network itself."""

import pytest
import torch

from baselines.firenet import FireNet
from baselines.highpass import HighPass
from src.models.e2vid import E2VID
from src.models.export import OnnxNetwork, export
from src.models.fast import Fast
from src.models.setnet import SetNet

NETWORKS = {
    "e2vid": lambda: E2VID(views=9, base_channels=4, spectral_norm=True),
    "setnet": lambda: SetNet(stem=4, channels=8),
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
    found = export(network, tmp_path / "net.onnx", views=9, height=32, width=32)
    torch.testing.assert_close(
        frames(found, noise()), frames(network, noise()), atol=1e-4, rtol=1e-3
    )
    assert isinstance(found, OnnxNetwork)


@pytest.mark.parametrize("name", NETWORKS)
def test_the_running_form_is_as_accurate_as_its_type(name):
    torch.manual_seed(0)
    network = NETWORKS[name]().eval()
    plain = frames(network, noise())
    assert torch.allclose(frames(Fast(network, dtype=torch.float32), noise()), plain, atol=1e-5)
    rounded = frames(Fast(network), noise())
    assert rounded.dtype == torch.float32 and (rounded - plain).abs().mean() < 0.02


def test_what_onnx_cannot_express_is_said(tmp_path):
    pytest.importorskip("onnxscript")
    with pytest.raises(ValueError, match="HighPass has a part that ONNX cannot express"):
        export(HighPass(source="median"), tmp_path / "a.onnx", views=9, height=16, width=16)


def test_an_empty_window_costs_nothing_and_changes_nothing():
    network = Fast(E2VID(views=9, base_channels=4))
    frame, state = network(noise()[0])
    again, after = network(torch.zeros(1, 9, 5, 32, 32), state)
    assert again is frame and after is state
    eager = Fast(E2VID(views=9, base_channels=4), skip_empty=False)
    frame, state = eager(noise()[0])
    assert not torch.equal(eager(torch.zeros(1, 9, 5, 32, 32), state)[0], frame)
