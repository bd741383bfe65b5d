"""Frames as a method, and the post-processor behind a method: input, output, cost."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from baselines.firenet import FireNet
from baselines.mambatm import MambaTM
from baselines.postprocess import CameraFrames, Postprocessed, Restoration
from src.app.parts import make
from src.metrics.image import L1
from src.models import files
from src.models.unroll import unroll, video
from src.sim.pipeline import Sample
from src.training.evaluation import cost
from src.training.idle import idle_share


def sample(windows: int = 10) -> Sample:
    torch.manual_seed(0)
    return Sample(
        voxels=torch.randn(1, windows, 1, 5, 16, 16),
        target=torch.rand(1, windows, 1, 16, 16),
        turbulent=torch.rand(1, windows, 1, 16, 16),
        window_s=torch.tensor([1 / 120]),
    )


class Doubled(nn.Module):
    """Stands for a post-processor: doubles, and counts what it is given."""

    def restore(self, frames, *, window, overlap):
        self.given = frames.shape[1]
        return (2 * frames).clamp(0, 1)


def test_an_exposure_is_the_mean_of_its_frames_shown_in_each_of_them():
    given = sample()
    assert torch.equal(CameraFrames().video(given), given.turbulent)
    shown = CameraFrames(4).video(given)
    assert shown.shape == given.turbulent.shape
    torch.testing.assert_close(shown[:, 3], given.turbulent[:, :4].mean(1))
    assert torch.equal(shown[:, 4], shown[:, 7]) and not torch.equal(shown[:, 3], shown[:, 4])
    torch.testing.assert_close(shown[:, 9], given.turbulent[:, 8:].mean(1))


def test_the_post_processor_gets_every_picture_once():
    given, doubled = sample(), Doubled()
    shown = Postprocessed(CameraFrames(4), doubled).video(given)
    assert doubled.given == 3
    torch.testing.assert_close(shown, (2 * CameraFrames(4).video(given)).clamp(0, 1))


@torch.no_grad()
def test_it_gets_what_the_network_makes_of_the_events():
    given, network = sample(), FireNet().eval()
    frames, _ = unroll(network, given.voxels)
    assert torch.equal(video(network, given), frames)
    shown = video(Postprocessed(network, Doubled()), given)
    torch.testing.assert_close(shown, (2 * frames.clamp(0, 1)).clamp(0, 1))


@torch.no_grad()
def test_the_cost_is_that_of_the_pair():
    given, network, restorer = sample(4), FireNet().eval(), MambaTM(states=2).eval()
    alone, behind_camera, pair = (
        cost(method, given)[0]
        for method in (
            network,
            Postprocessed(CameraFrames(), restorer),
            Postprocessed(network, restorer),
        )
    )
    assert pair == pytest.approx(alone + behind_camera, rel=0.2)  # the first frame has no state
    assert cost(CameraFrames(), given)[0] == 0


def test_training_changes_the_post_processor_and_not_its_source():
    source, restorer = FireNet(), MambaTM(states=2)
    module = Restoration(restorer, {}, source=source, loss=L1())
    assert not any(name.startswith("_source") for name in module.state_dict())
    frames, state = module.unrolled(sample(4), slice(None))
    assert frames.shape == (1, 4, 1, 16, 16) and state is None
    frames.sum().backward()
    assert all(p.grad is None for p in source.parameters())
    assert any(float(p.grad.abs().sum()) > 0 for p in restorer.parameters())
    assert 0 <= idle_share(module, [sample(4)]) < 1


@torch.no_grad()
def test_validation_sees_the_restored_frames():
    module = Restoration(MambaTM(states=2).eval(), {}, source=CameraFrames())
    given = sample(4)
    restored = module.network.restore(given.turbulent)
    assert torch.equal(video(module.method, given), restored)
    other = replace(given, turbulent=1 - given.turbulent)
    assert not torch.equal(video(module.method, other), restored)


@torch.no_grad()
def test_three_channels_take_grey_frames():
    network, frames = MambaTM(channels=3, states=2).eval(), torch.rand(1, 2, 1, 16, 16)
    grey, colour = network(frames)[0], network(frames.expand(-1, -1, 3, -1, -1))[0]
    assert grey.shape == frames.shape
    torch.testing.assert_close(grey, colour.mean(2, keepdim=True))


def test_bad_arguments_name_their_key(tmp_path):
    with pytest.raises(ValueError, match=r"baseline\.average"):
        CameraFrames(0)
    with pytest.raises(ValueError, match=r"postprocess\.restorer .* experiment=mambatm"):
        Postprocessed(CameraFrames(), "/nowhere")
    path = tmp_path / "firenet.safetensors"
    files.save(path, FireNet(), {"target": "baselines.firenet.FireNet", "kwargs": {}}, {})
    with pytest.raises(ValueError, match=r"postprocess\.restorer must be a post-processor"):
        Postprocessed(CameraFrames(), str(path))


def test_our_own_frozen_weights_load_by_name_or_path(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WEIGHTS", tmp_path)
    path = tmp_path / "clean" / "firenet_plus.safetensors"
    path.parent.mkdir()
    files.save(path, FireNet(), {"target": "baselines.firenet.FireNet", "kwargs": {}}, {})
    target = {"_target_": "baselines.upstream.from_config", "name": "firenet_plus"}
    by_name, by_path = (make(target | {"weights": w}) for w in ("clean/firenet_plus", str(path)))
    given = sample(1).voxels[:, 0]
    assert torch.equal(by_name(given, None)[0], by_path(given, None)[0])
    with pytest.raises(ValueError, match=r"baseline\.weights .* experiment=clean/etnet"):
        make(target | {"name": "etnet", "weights": "clean/etnet"})
    with pytest.raises(ValueError, match=r"baseline\.weights are not those of etnet"):
        make(target | {"name": "etnet", "weights": str(path)})
    with pytest.raises(ValueError, match=r"baseline\.weights .* authors' checkpoint"):
        make(target | {"name": "cista", "weights": None})
