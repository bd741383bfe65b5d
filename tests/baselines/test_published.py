"""Published weights load, reproduce the published outputs, and nothing of a file is executed."""

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from scipy import ndimage

from baselines import published
from baselines.e2vid_plus import E2VIDPlus
from baselines.firenet import FireNet
from src.app.instantiate import instantiate_node
from src.sim.voxel import voxel_grid
from tests.baselines.published_names import published_state_dict
from tests.conftest import ROOT

CONFIGS = ROOT / "conf" / "baseline"
FILES = {
    "firenet": "FireNet/firenet_state_dict.pth",
    "firenet_plus": "FireNet+/firenet_plus_state_dict.pth",
    "cista": "CISTA-TC/cista-tc.pth.tar",
    "pienet": "PIE-Net/model.pth",
    "pienet_package": "PIE-Net/model.pth",
    "pienet_lite": "PIE-Net/model_lite.pth",
}
# Of event-pienet 1.1.3 ("pienet": with n_rep_dn = [1, 1, 1], as its checkpoint has it): every sixth
# pixel of row 11 after the first and the fourth window of `few_events`.
PIE_NET_FRAMES = {
    "pienet": (
        [0.153001, 0.115957, 0.226795, 0.281091, 0.160237, 0.062087, 0.145532],
        [0.039624, 0.082345, 0.184097, 0.001708, 0.046368, 0.225082, 0.123234],
    ),
    "pienet_package": (
        [0.408599, 0.319073, 0.358896, 0.548899, 0.614033, 0.269857, 0.255031],
        [0.133544, 0.244154, 0.476306, 0.207072, 0.473983, 0.590085, 0.249149],
    ),
    "pienet_lite": (
        [0.106339, 0.138736, 0.505866, 0.426105, 0.23936, 0.173607, 0.13688],
        [0.07319, 0.231795, 0.449761, 0.109486, 0.17621, 0.350037, 0.109337],
    ),
}


class Shell:
    def __reduce__(self):
        return os.system, ("false",)


class Config:
    """As checkpoints hold it: of a class that is not here."""

    def __init__(self):
        self.folder, self.resumed = Path("runs"), np.float64(0.5)


@pytest.fixture(scope="module")
def slider(shared_data):
    folder = shared_data / "events" / "slider_depth"
    rows = np.loadtxt(folder / "events_chunk.txt")
    image = Image.open(folder / "images" / "frame_00000004.png").convert("L")
    windows = []
    for part in np.split(rows, 10):
        t = np.round(part[:, 0] * 1e6).astype(np.int64)
        x, y = part[:, 1].astype(np.uint16), part[:, 2].astype(np.uint16)
        p = np.where(part[:, 3] > 0, 1, -1).astype(np.int8)
        edges = {"t0": float(t.min()), "t1": float(t.max())}
        windows.append(voxel_grid(t, x, y, p, **edges, bins=5, height=180, width=240))
    return torch.stack(windows).float(), np.asarray(image, dtype=float) / 255


@pytest.mark.parametrize(
    ("name", "pixels", "gradients"),
    [("firenet", 0.601, 0.406), ("firenet_plus", 0.421, 0.328), ("cista", 0.717, 0.493)],
)
def test_published_weights_reach_the_published_correlation(
    shared_data, slider, name, pixels, gradients
):
    network = published.load_published(name, shared_data / "weights" / FILES[name])
    voxels, truth = slider
    state = None
    for grid in voxels:
        frame, state = network(grid[None, None], state)
    ours = frame[0, 0].numpy().astype(float)
    found = np.corrcoef(ours.ravel(), truth.ravel())[0, 1]
    # The numbers come without a definition of gradient.  Of central and forward differences and
    # Sobel, signed and as magnitude, only the Sobel magnitude agrees for both networks.
    steep = [np.hypot(ndimage.sobel(a, 0), ndimage.sobel(a, 1)).ravel() for a in (ours, truth)]
    assert found == pytest.approx(pixels, abs=0.01)
    assert np.corrcoef(*steep)[0, 1] == pytest.approx(gradients, abs=0.01)


def few_events() -> torch.Tensor:
    """Return four windows of five bins, 23x37, of -1, 0 and 1."""
    k = torch.arange(4 * 5 * 23 * 37, dtype=torch.float64)
    return (1.2 * torch.sin(k * k / 7)).trunc().float().view(4, 1, 1, 5, 23, 37)


@pytest.mark.parametrize("name", PIE_NET_FRAMES)
def test_pie_net_gives_the_frames_of_its_package(shared_data, name):
    network = published.load_published(name, shared_data / "weights" / FILES[name])
    state, rows = None, []
    for window in few_events():
        frame, state = network(window, state)
        rows.append(frame[0, 0, 11, ::6])
    expected = torch.tensor(PIE_NET_FRAMES[name])
    torch.testing.assert_close(torch.stack([rows[0], rows[3]]), expected, atol=1e-5, rtol=0)


def small(name: str) -> torch.nn.Module:
    known = published.NETWORKS[name]
    return known.network_class(**known.options, **{known.width_argument: 8})


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("name", list(published.NETWORKS))
def test_names_round_trip(name, zipped, tmp_path):
    network = small(name).eval()
    weights = published_state_dict(name, network)
    path = tmp_path / "published.pth"
    content = {"state_dict": weights, "config": Config()}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)
    again = published.load_published(name, path)
    voxels = torch.randn(2, 9, 5, 16, 16)
    assert torch.equal(network(voxels, None)[0], again(voxels, None)[0])


def test_e2vid_has_the_published_names():
    names = published_state_dict("e2vid_plus", E2VIDPlus(base_channels=8))
    assert len(names) == 30
    assert "unetrecurrent.encoders.2.recurrent_block.Gates.bias" in names
    assert "unetrecurrent.encoders.0.conv.conv2d.weight" in names


def test_etnet_has_the_published_names():
    names = published_state_dict("etnet", small("etnet"))
    assert len(names) == 254
    assert names["trans_encoder2.encoder.layers.0.self_attn.in_proj_weight"].shape == (192, 64)
    assert "trans_decoder0.decoder.layers.1.norm22.weight" in names
    assert "trans_decoder2.decoder.layers.0.cross_attn.out_proj.bias" in names
    assert {n.split(".")[0] for n in names} == {
        "head", "DownsampleConv", "UpsampleConv", "split1", "split2", "pred",
        *(f"trans_{part}{scale}" for part in ("encoder", "decoder") for scale in range(3)),
    }  # fmt: skip


def test_hypere2vid_has_the_published_names():
    names = published_state_dict("hypere2vid", small("hypere2vid"))
    first = {n.split("decoders.0.")[1] for n in names if "decoders.0." in n}
    assert {n for n in first if "bases_net" not in n} == {
        "context_fusion.conv.weight", "context_fusion.conv.bias", "dynamic_atom_generation.bases",
        "dynamic_conv.compositional_coefficients", "dynamic_conv.bias",
    }  # fmt: skip
    assert "dynamic_atom_generation.bases_net.4.running_var" in first
    assert names["unetrecurrent.decoders.2.conv2d.weight"].shape == (8, 16, 5, 5)


def test_pie_net_as_its_package_runs_it_leaves_three_layers_of_the_checkpoint_out():
    whole = published_state_dict("pienet", small("pienet"))
    ran = published_state_dict("pienet_package", small("pienet_package"))
    assert set(ran) < set(whole) and len(whole) == 92
    left_out = {name.split("mbconv.")[0] for name in set(whole) - set(ran)}
    assert left_out == {f"model.downs.{scale}.out.mbconv_0." for scale in range(3)}


def test_missing_and_extra_weights_are_listed(tmp_path):
    weights = published_state_dict("firenet", FireNet())
    weights["stranger"] = weights.pop("net.pred.conv2d.bias")
    torch.save(weights, tmp_path / "other.pth")
    with pytest.raises(ValueError, match=r"missing \['net.pred.conv2d.bias'\], extra \['stranger"):
        published.load_published("firenet", tmp_path / "other.pth")


def test_a_pickle_that_wants_to_run_code_is_refused(tmp_path):
    path = tmp_path / "bad.pth"
    torch.save({"state_dict": Shell()}, path)
    with pytest.raises(ValueError, match=r"baseline\.weights"):
        published.load_published("firenet", path)
    path.write_bytes(pickle.dumps(Shell()))
    with pytest.raises(ValueError, match=r"baseline\.weights"):
        published.load_published("firenet", path)


@pytest.mark.parametrize("name", list(published.NETWORKS))
def test_every_published_network_has_a_config(name, tmp_path):
    path = tmp_path / "published.pth"
    torch.save(published_state_dict(name, small(name)), path)
    node = OmegaConf.load(CONFIGS / f"{name}.yaml")
    node.weights = str(path)
    assert instantiate_node(node).normalise == published.NETWORKS[name].options["normalise"]
