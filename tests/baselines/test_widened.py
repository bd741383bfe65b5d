"""Networks widened to a light field start as the published ones, on nine equal views."""

import pytest
import torch

from baselines import upstream, widened
from baselines.cista import CISTA
from baselines.firenet import FireNet
from baselines.widened import GAIN, LightFieldCISTA, LightFieldFireNet
from src.models.unroll import unroll

PAIRS = [
    (LightFieldFireNet(channels=4), FireNet(channels=4), "head"),
    (LightFieldCISTA(channels=4), CISTA(channels=4), "events"),
]


@pytest.mark.parametrize(("wide", "narrow", "first"), PAIRS)
@torch.no_grad()
def test_equal_views_give_the_published_frames(wide, narrow, first, tmp_path):
    torch.save(upstream.export(wide.published, narrow), tmp_path / "published.pth")
    widened.start(wide, str(tmp_path / "published.pth"))
    view = torch.randn(2, 3, 1, 5, 16, 16)
    ours, _ = unroll(wide.eval(), view.repeat(1, 1, 9, 1, 1, 1))
    getattr(narrow, first).weight.mul_(GAIN)
    theirs, _ = unroll(narrow.eval(), view)
    assert torch.allclose(ours, theirs, atol=1e-5)


def test_parameter_counts():
    assert sum(p.numel() for p in LightFieldFireNet().parameters()) == 43_537
    assert sum(p.numel() for p in LightFieldCISTA().parameters()) == 1_272_387


def test_the_real_weights_are_taken(shared_data):
    network = LightFieldFireNet()
    widened.start(network, str(shared_data / "weights/FireNet+/firenet_plus_state_dict.pth"))
    first = network.head.weight
    assert torch.equal(first[:, :5], first[:, 40:]) and first.abs().max() > 0.01


def test_another_width_and_a_missing_file_name_their_key(tmp_path):
    torch.save(upstream.export("firenet_plus", FireNet(channels=8)), tmp_path / "published.pth")
    with pytest.raises(ValueError, match=r"model\.weights must have the sizes of model\.channels"):
        widened.start(LightFieldFireNet(), str(tmp_path / "published.pth"))
    with pytest.raises(ValueError, match=r"model\.weights must be a file"):
        widened.start(LightFieldFireNet(), "nowhere.pth")


def test_other_views_are_refused():
    with pytest.raises(ValueError, match=r"optics\.views, bins must be \(9, 5\)"):
        LightFieldFireNet()(torch.zeros(1, 4, 5, 8, 8), None)
