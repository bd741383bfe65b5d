"""LPIPS: the published distances, torchmetrics' own class, errors."""

import cv2
import pytest
import torch
from torch import nn

from src.losses.terms import LPIPSTerm
from src.metrics import lpips
from src.metrics.lpips import LPIPS

PUBLISHED = {"alex": (0.721881, 0.137566), "vgg": (0.568613, 0.421664)}


def build(net: str) -> LPIPS:
    if not (lpips.BACKBONE_FOLDER / f"{net}.safetensors").is_file():
        pytest.skip(f"no ImageNet weights of {net} in {lpips.BACKBONE_FOLDER}")
    return LPIPS(net)


def picture(path) -> torch.Tensor:
    rgb = cv2.imread(str(path))[..., ::-1].copy()
    return torch.from_numpy(rgb).permute(2, 0, 1)[None].float() / 255


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_published_distances(net, shared_data):
    folder = shared_data / "lpips_reference"
    reference = picture(folder / "ex_ref.png")
    measure = build(net)
    for name, distance in zip(("ex_p0.png", "ex_p1.png"), PUBLISHED[net], strict=True):
        assert abs(float(measure(picture(folder / name), reference)) - distance) < 1e-4


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_agrees_with_torchmetrics_on_the_same_weights(net, monkeypatch):
    from torchmetrics.functional.image import lpips as theirs

    ours = build(net)
    layers = nn.Sequential(*[layer for stage in ours.stages for layer in stage])
    monkeypatch.setattr(theirs, "_get_tv_model_features", lambda *_, **__: layers)
    reference = theirs._LPIPS(pretrained=True, net=net, pnet_rand=False)
    a, b = torch.rand(2, 2, 3, 64, 64, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(ours(a, b), reference(2 * a - 1, 2 * b - 1).flatten(), atol=1e-5)


@pytest.mark.parametrize("net", ["alex", "vgg"])
@pytest.mark.parametrize("size", [(48, 48), (35, 49), (66, 64)])
def test_grey_equals_grey_repeated_and_so_do_gradients(net, size):
    measure = build(net)
    a, b = torch.rand(2, 2, 1, *size, generator=torch.Generator().manual_seed(1))
    a.requires_grad_()
    grey, colour = measure(a, b), measure(a.expand(-1, 3, -1, -1), b.expand(-1, 3, -1, -1))
    torch.testing.assert_close(grey, colour, rtol=1e-4, atol=1e-6)
    slopes = [torch.autograd.grad(value.sum(), a)[0] for value in (grey, colour)]
    torch.testing.assert_close(*slopes, rtol=1e-3, atol=1e-6)
    assert float(slopes[0].abs().sum()) > 0
    assert all(parameter.grad is None for parameter in measure.parameters())
    assert float(measure(b, b).abs().max()) == 0


def test_a_silent_place_has_a_finite_gradient():
    features = torch.zeros(1, 4, 2, 2, requires_grad=True)
    lpips._normalise_channels(features).sum().backward()
    assert features.grad.isfinite().all()


def test_it_never_trains():
    measure = build("alex").train()
    assert not measure.training and not any(p.requires_grad for p in measure.parameters())


def test_small_pictures_and_unknown_nets_are_refused():
    with pytest.raises(ValueError, match=r"^metrics\.lpips\.net must be alex or vgg, got squeeze"):
        LPIPS("squeeze")
    with pytest.raises(ValueError, match=r"^loss\.lpips\.net must be alex or vgg, got squeeze"):
        LPIPSTerm(net="squeeze")
    small, message = torch.rand(1, 1, 16, 16), "resolution_scale must be >= 32 px"
    with pytest.raises(ValueError, match=rf"^data\.test_crop times metrics\.{message}"):
        build("alex")(small, small)
    with pytest.raises(ValueError, match=r"^data\.crop must be >= 32 px"):
        LPIPSTerm()(small, small)


def test_without_weights_the_ways_to_get_them_are_named(tmp_path, monkeypatch):
    monkeypatch.setattr(lpips, "BACKBONE_FOLDER", tmp_path)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(ValueError, match=r"\(1\).*\(2\) metrics\.lpips\.backbone.*loss=l1"):
        LPIPS("alex")
    with pytest.raises(ValueError, match="lpips.backbone_weights"):
        LPIPS("alex", backbone_weights=str(tmp_path / "absent.pth"))


def test_another_file_is_not_taken_for_the_backbone(tmp_path):
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"lpips.backbone_weights.*features.0.weight"):
        LPIPS("alex", backbone_weights=str(tmp_path / "other.pth"))


def test_torchvision_s_own_file_loads(tmp_path):
    ours = build("alex")
    named = {
        f"features.{place}.{part}": getattr(layer, part)
        for place, layer in enumerate(layer for stage in ours.stages for layer in stage)
        if isinstance(layer, nn.Conv2d)
        for part in ("weight", "bias")
    }
    torch.save(named | {"classifier.1.weight": torch.zeros(2)}, tmp_path / "alexnet.pth")
    again = LPIPS("alex", backbone_weights=str(tmp_path / "alexnet.pth"))
    a, b = torch.rand(2, 1, 1, 32, 32)
    assert torch.equal(ours(a, b), again(a, b))
