"""LPIPS: the published distances, torchmetrics' own class, errors."""

import socket

import cv2
import pytest
import torch
from torch import nn

from src.metrics import lpips
from src.metrics.lpips import LPIPS

PUBLISHED = {"alex": (0.721881, 0.137566), "vgg": (0.568613, 0.421664)}


def build(net: str) -> LPIPS:
    if not (lpips.CACHE / f"{net}.safetensors").is_file():
        pytest.skip(f"no ImageNet weights of {net} in {lpips.CACHE}")
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
    lpips._unit(features).sum().backward()
    assert features.grad.isfinite().all()


def test_a_share_of_the_pictures_has_the_same_mean():
    a, b = torch.rand(2, 4, 1, 32, 32, generator=torch.Generator().manual_seed(0))
    whole, part = (lpips.AnchoredLPIPS("alex", share=share) for share in (1.0, 0.25))
    distance = LPIPS.forward(whole, a, b)
    anchors, chosen = whole(a, b) - distance, set()
    for seed in range(40):
        drawn, again = (part(a, b, torch.Generator().manual_seed(seed)) for _ in range(2))
        assert torch.equal(drawn, again)
        place = int((drawn - anchors).argmax())
        wanted = anchors.index_add(0, torch.tensor([place]), 4 * distance[[place]])
        assert torch.allclose(drawn, wanted, atol=1e-5)
        chosen.add(place)
    assert chosen == {0, 1, 2, 3}
    with pytest.raises(ValueError, match="loss.share"):
        lpips.AnchoredLPIPS("alex", share=0.0)


def test_it_never_trains():
    measure = build("alex").train()
    assert not measure.training and not any(p.requires_grad for p in measure.parameters())


def test_small_pictures_and_unknown_nets_are_refused():
    with pytest.raises(ValueError, match="loss.net must be alex or vgg, got squeeze"):
        LPIPS("squeeze")
    small = torch.rand(1, 1, 16, 16)
    with pytest.raises(ValueError, match="data.crop must be >= 32"):
        build("alex")(small, small)


def test_without_weights_all_three_ways_are_named(tmp_path, monkeypatch):
    def no_network(*_, **__):
        raise OSError("no network")

    monkeypatch.setattr(lpips, "CACHE", tmp_path)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", no_network)
    with pytest.raises(ValueError, match=r"\(1\).*\(2\).*\(3\).*loss=l1"):
        LPIPS("alex")
    with pytest.raises(ValueError, match="loss.backbone"):
        LPIPS("alex", backbone=str(tmp_path / "absent.pth"))


def test_a_download_is_checked_and_runs_no_code(monkeypatch):
    asked = {}

    def fetch(url, **options):
        asked.update(options, url=url, patience=socket.getdefaulttimeout())
        raise TimeoutError

    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", fetch)
    before = socket.getdefaulttimeout()
    assert lpips._download("vgg") is None
    assert asked["url"].endswith("vgg16-397923af.pth")
    assert asked["check_hash"] and asked["weights_only"]
    assert asked["patience"] == lpips.PATIENCE_S and socket.getdefaulttimeout() == before


def test_another_file_is_not_taken_for_the_backbone(tmp_path):
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"loss.backbone.*features.0.weight"):
        LPIPS("alex", backbone=str(tmp_path / "other.pth"))


def test_torchvision_s_own_file_loads(tmp_path):
    ours = build("alex")
    named = {
        f"features.{place}.{part}": getattr(layer, part)
        for place, layer in enumerate(layer for stage in ours.stages for layer in stage)
        if isinstance(layer, nn.Conv2d)
        for part in ("weight", "bias")
    }
    torch.save(named | {"classifier.1.weight": torch.zeros(2)}, tmp_path / "alexnet.pth")
    again = LPIPS("alex", backbone=str(tmp_path / "alexnet.pth"))
    a, b = torch.rand(2, 1, 1, 32, 32)
    assert torch.equal(ours(a, b), again(a, b))
