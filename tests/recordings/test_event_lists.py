"""Frames from lists of events are those from grids, resampled views, empty windows and all."""

import numpy as np
import pytest
import torch

from baselines.firenet import FireNet
from src.models.e2vid import E2VID
from src.models.fast import Fast
from src.models.runtime import Runtime
from src.models.setnet import SetNet
from src.recordings import event_lists, lookup, stream
from src.recordings.capture import kaleidoscope
from src.recordings.files.formats import EVENT
from src.sim.optics import layout

SENSOR = {"sensor": (96, 120), "tile_px": 36.0, "misalignment_px": 0.5}
VIEWS = kaleidoscope(list(layout(9)), model=(24, 32), **SENSOR)
NETWORKS = {
    "setnet": lambda: SetNet(half=4),
    "e2vid": lambda: E2VID(views=9, base_channels=4),
}


def recording() -> np.ndarray:
    """Events of 50 ms with a pause of 20 in the middle."""
    rng = np.random.default_rng(0)
    made = np.empty(4000, EVENT)
    made["t"] = np.sort(rng.choice(np.r_[0:15_000, 35_000:50_000], 4000))
    made["x"], made["y"] = rng.integers(0, 120, 4000), rng.integers(0, 96, 4000)
    made["p"] = rng.integers(0, 2, 4000) * 2 - 1
    return made


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize(
    "cut",
    [
        {"fps": 240.0},
        {"fps": 240.0, "splat": "nearest", "unit": "mass"},
        {"fps": 600.0, "overlap": 5},
        {"count": 300},
    ],
)
def test_the_frames_are_those_from_grids(name, cut):
    torch.manual_seed(0)
    network, table = NETWORKS[name]().eval(), lookup.build(VIEWS)
    span = cut.get("overlap", 1)
    grids = stream.windows([recording()], table, stream.Rule(**cut))
    dense = list(stream.frames(grids, network, overlap=span, positions=VIEWS.positions))
    lists = stream.windows([recording()], table, stream.Rule(**cut, grids=False))
    runtime, carry = event_lists.ready(network, "float32", "cpu", VIEWS, 5), stream.Carry()
    found = []
    for window in lists:  # law 6: each window a call of its own
        found += event_lists.frames([window], runtime, overlap=span, carry=carry)
    assert len(found) == len(dense) > 5
    for one, other in zip(dense, found, strict=True):
        assert (one.time_s, one.events, one.outside) == (other.time_s, other.events, other.outside)
        np.testing.assert_allclose(one.picture, other.picture, atol=1e-5)


def test_what_is_run_follows_from_network_and_device():
    network = SetNet(half=4)
    assert isinstance(event_lists.ready(network, "bf16", "cpu", VIEWS, 5), Runtime)
    assert isinstance(event_lists.ready(FireNet(), "bf16", "cpu", VIEWS, 5), Fast)
    with pytest.raises(ValueError, match="bins must be 5 for this network, got 3"):
        event_lists.ready(network, "bf16", "cpu", VIEWS, 3)
    with pytest.raises(ValueError, match="device must be cpu for form=openvino, got cuda"):
        event_lists.ready(network, "openvino", "cuda", VIEWS, 5)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("cut", [{"fps": 240.0}, {"fps": 600.0, "overlap": 5}])
def test_lists_of_events_backwards_are_the_grids_backwards(name, cut):
    torch.manual_seed(0)
    network, table = NETWORKS[name]().eval(), lookup.build(VIEWS)
    span = cut.get("overlap", 1)
    runtime = event_lists.ready(network, "float32", "cpu", VIEWS, 5)
    shown = []
    for grids in (True, False):
        carry, rule = stream.Carry(), stream.Rule(**cut, grids=grids)
        more = {"overlap": span, "carry": carry}
        for windows in (stream.backwards, stream.windows):
            ahead = [0.03] if windows is stream.backwards else []
            made = windows([recording()], table, rule, *ahead)
            if grids:
                found = list(stream.frames(made, network, positions=VIEWS.positions, **more))
            else:
                found = list(event_lists.frames(made, runtime, **more))
            if ahead:
                assert len(found) == {240.0: 7, 600.0: 15}[cut["fps"]]
                carry.turn()
        shown.append(np.stack([frame.picture for frame in found]))
    np.testing.assert_allclose(*shown, atol=1e-5)
