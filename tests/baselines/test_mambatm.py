"""The post-processor: published size, any length and frame, every part at work."""

import pytest
import torch
from omegaconf import OmegaConf

from baselines import mambatm
from baselines.mambatm import MambaTM, row_time_hilbert_orders
from baselines.stabilise import backward_warp_video, estimate_jitter
from src.app.instantiate import instantiate_node
from src.models.network import FramePostprocessor
from tests.conftest import ROOT
from tests.models.learning import learn_by_heart


def small(stabilise_input: bool = False) -> MambaTM:
    torch.manual_seed(0)
    network = MambaTM(states=2, stabilise_input=stabilise_input).eval()
    torch.nn.init.normal_(network.decoder.out[-1].weight, std=0.1)
    return network


@torch.no_grad()
def test_it_begins_as_the_identity():
    frames = torch.rand(1, 2, 1, 16, 16)
    assert torch.equal(MambaTM(states=2)(frames)[0], frames)


@torch.no_grad()
def test_stabilise_input_it_begins_as_the_frames_held_still():
    frames = torch.rand(1, 4, 1, 32, 32)
    still = backward_warp_video(frames, estimate_jitter(frames))
    torch.testing.assert_close(MambaTM(states=2, stabilise_input=True)(frames)[0], still)


@pytest.mark.parametrize(
    ("name", "parameters"), [("mambatm", 998_229), ("mambatm_published", 7_239_319)]
)
def test_parameter_counts(name, parameters):
    network = instantiate_node(OmegaConf.load(ROOT / "conf" / "model" / f"{name}.yaml"))
    assert sum(p.numel() for p in network.parameters()) == parameters


@pytest.mark.parametrize("shape", [(1, 1, 16, 16), (2, 3, 17, 30)])
@torch.no_grad()
def test_any_frame_comes_back(shape):
    n, frames, height, width = shape
    clean, distortion = small()(torch.rand(n, frames, 1, height, width))
    assert clean.shape == (n, frames, 1, height, width)
    assert distortion.shape == (n, frames, 4, height, width)


@torch.no_grad()
def test_clips_of_a_batch_do_not_meet():
    network, frames = small(), torch.rand(2, 3, 1, 16, 16)
    torch.testing.assert_close(network(frames)[0][1:], network(frames[1:])[0])


@pytest.mark.parametrize(
    ("frames", "starts"),
    [(1, [0]), (16, [0]), (17, [0, 1]), (40, [0, 12, 24]), (41, [0, 12, 24, 25])],
)
def test_windows_cover_the_video(frames, starts):
    seen = []

    class Listed(FramePostprocessor):
        def forward(self, part):
            seen.append(round(100 * float(part[0, 0, 0, 0, 0])))
            return part, None

    video = torch.arange(frames).view(1, -1, 1, 1, 1) / 100
    assert torch.equal(Listed().restore(video), video) and seen == starts


@pytest.mark.parametrize("frames", [37, 40, 45, 60])
def test_each_frame_is_of_the_window_in_which_it_lies_deeper(frames):
    class Depth(FramePostprocessor):
        def forward(self, part):
            inside = torch.arange(part.shape[1])
            depth = torch.minimum(inside, part.shape[1] - 1 - inside)
            return (depth / 100).view(1, -1, 1, 1, 1), None

    last = frames - 16
    starts = [*range(0, last, 12), last]
    deepest = [
        max(min(k - s, s + 15 - k) for s in starts if s <= k < s + 16) for k in range(frames)
    ]
    found = (100 * Depth().restore(torch.zeros(1, frames, 1, 1, 1))).round().flatten().tolist()
    assert found == deepest


@torch.no_grad()
def test_frames_encoded_one_by_one_give_the_same(monkeypatch):
    network, frames = small(), torch.rand(1, 3, 1, 16, 24)
    together = network(frames)
    monkeypatch.setattr(mambatm, "PIXELS", 1)
    for one, other in zip(network(frames), together, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("count", [1, 3, 4, 5, 9, 11])
@torch.no_grad()
def test_a_video_of_any_length(count):
    network, frames = small(), torch.rand(1, count, 1, 16, 16)
    network.WINDOW, network.OVERLAP = 4, 2
    clean = network.restore(frames)
    assert clean.shape == frames.shape
    assert 0 <= float(clean.min()) <= float(clean.max()) <= 1
    if count <= 4:
        assert torch.equal(clean, network(frames)[0].clamp(0, 1))


@torch.no_grad()
def test_windows_give_their_inner_frames():
    network, frames = small(), torch.rand(1, 6, 1, 16, 16)
    network.WINDOW, network.OVERLAP = 4, 2
    whole = network.restore(frames)
    first, last = (network(part)[0].clamp(0, 1) for part in (frames[:, :4], frames[:, 2:]))
    torch.testing.assert_close(whole, torch.cat([first[:, :3], last[:, 1:]], 1))


def test_orders_are_permutations_of_the_box():
    raster, in_time, curve = row_time_hilbert_orders(3, 4, 5)
    for order in (raster, in_time, curve):
        assert torch.equal(order.sort().values, torch.arange(60))
    assert in_time[:4].tolist() == [0, 20, 40, 5]  # all times of a place, then the place below


@pytest.mark.parametrize("stabilise_input", [False, True])
def test_gradients_reach_every_parameter(stabilise_input):
    network = small(stabilise_input).train()
    clean, distortion = network(torch.rand(1, 5, 1, 32, 32))
    ((clean * torch.randn_like(clean)).sum() + distortion.sum()).backward()
    idle = [name for name, p in network.named_parameters() if float(p.grad.abs().sum()) == 0]
    assert idle == []


def test_it_can_learn_one_clip_by_heart():
    network, frames = small().train(), torch.rand(1, 4, 1, 16, 16)
    target = torch.nn.functional.avg_pool2d(frames.flatten(0, 1), 3, 1, 1).view_as(frames)
    assert learn_by_heart(network, lambda: network(frames)[0], target, 3e-3, 15) < 0.2


def test_bad_arguments_name_their_key():
    with pytest.raises(ValueError, match=r"postprocess\.scan_blocks"):
        MambaTM(scan_blocks=1)
    with pytest.raises(ValueError, match=r"postprocess\.base_channels"):
        MambaTM(base_channels=4)
