"""Frames as a method, and the post-processor behind a method: input, output, cost."""

from dataclasses import replace

import pytest
import torch

from baselines import etnet, hypere2vid, published
from baselines.firenet import FireNet
from baselines.mambatm import MambaTM
from baselines.postprocess import CameraFrames, Postprocessed
from src.app.instantiate import instantiate_node
from src.losses.terms import L1Term, TrainingLoss
from src.models import files
from src.models.network import FramePostprocessor, unroll
from src.sim.pipeline import Sample
from src.training.evaluation import measure_macs_and_ms
from src.training.reconstructor import PostprocessorTraining


def sample(windows: int = 10) -> Sample:
    torch.manual_seed(0)
    return Sample(
        voxels=torch.randn(1, windows, 1, 5, 16, 16),
        target=torch.rand(1, windows, 1, 16, 16),
        turbulent=torch.rand(1, windows, 1, 16, 16),
        window_s=torch.tensor([1 / 120]),
    )


class Doubled(FramePostprocessor):
    """Stands for a post-processor: doubles, and counts what it is given."""

    def restore(self, frames):
        self.given = frames.shape[1]
        return (2 * frames).clamp(0, 1)


def test_an_exposure_is_the_mean_of_its_frames_shown_in_each_of_them():
    given = sample()
    assert torch.equal(CameraFrames().reconstruct_clip(given), given.turbulent)
    shown = CameraFrames(4).reconstruct_clip(given)
    assert shown.shape == given.turbulent.shape
    torch.testing.assert_close(shown[:, 3], given.turbulent[:, :4].mean(1))
    assert torch.equal(shown[:, 4], shown[:, 7]) and not torch.equal(shown[:, 3], shown[:, 4])
    torch.testing.assert_close(shown[:, 9], given.turbulent[:, 8:].mean(1))


def test_the_post_processor_gets_every_picture_once():
    given, doubled = sample(), Doubled()
    shown = Postprocessed(CameraFrames(4), doubled).reconstruct_clip(given)
    assert doubled.given == 3
    torch.testing.assert_close(shown, (2 * CameraFrames(4).reconstruct_clip(given)).clamp(0, 1))


@torch.no_grad()
def test_it_gets_what_the_network_makes_of_the_events():
    given, network = sample(), FireNet().eval()
    frames, _ = unroll(network, given.voxels)
    assert torch.equal(network.reconstruct_clip(given), frames)
    shown = Postprocessed(network, Doubled()).reconstruct_clip(given)
    torch.testing.assert_close(shown, (2 * frames.clamp(0, 1)).clamp(0, 1))


@torch.no_grad()
def test_the_cost_is_that_of_the_pair():
    given, network, restorer = sample(4), FireNet().eval(), MambaTM(states=2).eval()
    alone, behind_camera, pair = (
        measure_macs_and_ms(method, given)[0]
        for method in (
            network,
            Postprocessed(CameraFrames(), restorer),
            Postprocessed(network, restorer),
        )
    )
    assert pair == pytest.approx(alone + behind_camera, rel=0.2)  # the first frame has no state
    assert measure_macs_and_ms(CameraFrames(), given)[0] == 0


def test_training_changes_the_post_processor_and_not_its_source():
    source, restorer = FireNet(), MambaTM(states=2)
    loss = TrainingLoss({"l1": L1Term()})
    method = Postprocessed(source, restorer)
    module = PostprocessorTraining(restorer, {}, method=method, loss=loss)
    assert all(name.startswith("network.") for name in module.state_dict())
    frames = module.reconstruct_windows(sample(4), [0, 3])
    assert frames.shape == (1, 2, 1, 16, 16)
    frames.sum().backward()
    assert all(p.grad is None for p in source.parameters())
    assert any(float(p.grad.abs().sum()) > 0 for p in restorer.parameters())


def test_the_source_is_on_the_training_device_before_anything_is_scored():
    method, loss = Postprocessed(FireNet(), MambaTM(states=2)), TrainingLoss({"l1": L1Term()})
    module = PostprocessorTraining(method.postprocessor, {}, method=method, loss=loss).to("meta")
    module.on_fit_start()
    assert all(p.is_meta for p in method.source.parameters())


@torch.no_grad()
def test_training_gets_each_long_exposure_once_as_a_test_does():
    restorer = MambaTM(states=2).eval()
    method = Postprocessed(CameraFrames(4), restorer)
    module = PostprocessorTraining(restorer, {}, method=method)
    given = sample()
    trained = module.reconstruct_windows(given, [0, 5, 9]).clamp(0, 1)
    torch.testing.assert_close(trained, method.reconstruct_clip(given)[:, [0, 5, 9]])


@torch.no_grad()
def test_validation_sees_the_restored_frames():
    restorer = MambaTM(states=2).eval()
    module = PostprocessorTraining(restorer, {}, method=Postprocessed(CameraFrames(), restorer))
    given = sample(4)
    restored = module.network.restore(given.turbulent)
    assert torch.equal(module.method.reconstruct_clip(given), restored)
    other = replace(given, turbulent=1 - given.turbulent)
    assert not torch.equal(module.method.reconstruct_clip(other), restored)


@torch.no_grad()
def test_three_channels_take_grey_frames():
    network, frames = MambaTM(frame_channels=3, states=2).eval(), torch.rand(1, 2, 1, 16, 16)
    grey, colour = network(frames)[0], network(frames.expand(-1, -1, 3, -1, -1))[0]
    assert grey.shape == frames.shape
    torch.testing.assert_close(grey, colour.mean(2, keepdim=True))


def test_bad_arguments_name_their_key(tmp_path):
    with pytest.raises(ValueError, match=r"baseline\.exposure_frames"):
        CameraFrames(0)
    with pytest.raises(ValueError, match=r"postprocess\.postprocessor .* experiment=mambatm"):
        Postprocessed(CameraFrames(), "/nowhere")
    path = tmp_path / "firenet.safetensors"
    files.save(path, FireNet(), {"target": "baselines.firenet.FireNet", "kwargs": {}}, {})
    with pytest.raises(ValueError, match=r"postprocess\.postprocessor must be a post-processor"):
        Postprocessed(CameraFrames(), str(path))


def test_our_own_frozen_weights_load_by_name_or_path(tmp_path, monkeypatch):
    monkeypatch.setattr(files, "WEIGHTS", tmp_path)
    path = tmp_path / "clean" / "firenet_plus.safetensors"
    path.parent.mkdir()
    files.save(path, FireNet(), {"target": "baselines.firenet.FireNet", "kwargs": {}}, {})
    target = {"_target_": "baselines.published.load_pretrained", "architecture": "firenet_plus"}
    by_name, by_path = (
        instantiate_node(target | {"weights": w}) for w in ("clean/firenet_plus", str(path))
    )
    given = sample(1).voxels[:, 0]
    assert torch.equal(by_name(given, None)[0], by_path(given, None)[0])
    with pytest.raises(ValueError, match=r"baseline\.weights .* experiment=clean/etnet"):
        instantiate_node(target | {"architecture": "etnet", "weights": "clean/etnet"})
    with pytest.raises(ValueError, match=r"baseline\.weights are not those of etnet"):
        instantiate_node(target | {"architecture": "etnet", "weights": str(path)})
    with pytest.raises(ValueError, match=r"baseline\.weights .* authors' checkpoint"):
        instantiate_node(target | {"architecture": "cista", "weights": None})


@pytest.mark.parametrize("kind", [etnet.ETNet, hypere2vid.HyperE2VID])
def test_weights_of_a_kind_of_e2vid_plus_are_not_those_of_e2vid_plus(kind, tmp_path):
    target = f"{kind.__module__}.{kind.__name__}"
    spec = {"target": target, "kwargs": {"base_channels": 4}}
    path = tmp_path / "a.safetensors"
    files.save(path, kind(base_channels=4), spec, {})
    with pytest.raises(ValueError, match=r"not those of e2vid_plus: a \w+ is in"):
        published.load_pretrained("e2vid_plus", str(path))
