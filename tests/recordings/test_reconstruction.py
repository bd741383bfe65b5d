"""Frames from lists of events are those from grids, resampled views, empty windows and all."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from baselines.firenet import FireNet
from src.deploy.forms import Bf16Network, convert_to_form
from src.deploy.runtime import EventListRuntime
from src.models.e2vid import E2VID
from src.models.setnet import SetNet
from src.recordings import event_windows, reconstruction, sensor_lookup
from src.recordings.files.event_file import EVENT
from src.recordings.reconstruction import ReconstructionState, reconstruct_frames
from src.recordings.simulated_recording import kaleidoscope_views
from src.sim.optics import layout

SENSOR = {"sensor": (96, 120), "tile_px": 36.0, "homography_error_px": 0.5}
VIEWS = kaleidoscope_views(list(layout(9)), model=(24, 32), **SENSOR)
NETWORKS = {
    "setnet": lambda: SetNet(channels=4),
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
        {"fps": 240.0, "splat": "nearest"},
        {"fps": 600.0, "frames_per_window": 5},
        {"fps": 1200.0, "frames_per_window": 5, "grows": True},
    ],
)
def test_the_frames_are_those_from_grids(name, cut):
    torch.manual_seed(0)
    network, table = NETWORKS[name]().eval(), sensor_lookup.build_lookup(VIEWS)
    span = event_windows.WindowRule(**cut).overlapping_windows
    grids = event_windows.cut_windows([recording()], table, event_windows.WindowRule(**cut))
    dense = list(reconstruct_frames(grids, network, VIEWS.positions, ReconstructionState(span)))
    lists = event_windows.cut_windows(
        [recording()], table, event_windows.WindowRule(**cut, as_lists=True)
    )
    runtime, state = (
        reconstruction.build_runnable_network(network, "float32", "cpu", VIEWS, 5),
        ReconstructionState(span),
    )
    found = []
    for window in lists:  # law 6: each window a call of its own
        found += reconstruct_frames([window], runtime, state=state)
    assert len(found) == len(dense) > 5
    for one, other in zip(dense, found, strict=True):
        assert (one.time_s, one.events, one.events_outside) == (
            other.time_s,
            other.events,
            other.events_outside,
        )
        np.testing.assert_allclose(one.picture, other.picture, atol=1e-5)


def moving_then_still() -> np.ndarray:
    """Events of 20 ms in the middle of the sensor, none for 0.1 s, then a few of noise."""
    rng, made = np.random.default_rng(1), np.empty(3100, EVENT)
    noise = rng.choice(np.arange(120_000, 160_000), 100)
    made["t"] = np.sort(np.r_[rng.choice(20_000, 3000), noise])
    made["x"], made["y"] = rng.integers(30, 90, 3100), rng.integers(24, 72, 3100)
    made["p"] = rng.integers(0, 2, 3100) * 2 - 1
    return made


def frames_of_every_window(network, windows) -> list[np.ndarray]:
    """Return what `network` makes of each window, none left out."""
    found, state = [], None
    for window in windows:
        if isinstance(network, EventListRuntime):
            found.append(network.step(*window.event_list, 0.0, window.length_s))
            continue
        voxels = torch.from_numpy(window.voxels.copy())[None]
        with torch.inference_mode():
            frame, state = network(
                voxels, state, window_s=window.length_s, positions=VIEWS.positions
            )
        found.append(frame[0, 0].numpy())
    return found


@pytest.mark.parametrize("fps", [120.0, 600.0])
@pytest.mark.parametrize(
    "engine, form",
    [("grids", "float32"), ("grids", "bf16"), ("lists", "float32"), ("lists", "bf16")],
)
def test_a_silence_is_that_of_the_network_on_every_window(engine, form, fps):
    torch.manual_seed(0)
    network, table = SetNet(channels=4).eval(), sensor_lookup.build_lookup(VIEWS)
    rule = event_windows.WindowRule(fps=fps, as_lists=engine == "lists")
    windows = list(event_windows.cut_windows([moving_then_still()], table, rule))
    empty = [window.events == 0 for window in windows]
    assert sum(empty) > 0.1 * fps - 2 and not empty[-1]

    def build():
        if engine == "grids":
            return convert_to_form(network, form)
        return reconstruction.build_runnable_network(network, form, "cpu", VIEWS, 5)

    wanted = frames_of_every_window(build(), windows)
    frames = reconstruct_frames(windows, build(), VIEWS.positions)
    found = [frame.picture for frame in frames]
    np.testing.assert_allclose(found, wanted, atol=1e-5)
    first = empty.index(True)
    assert np.ptp(found[first - 1 : first + 1], 0).max() > 1e-4  # its areas fade a while


@pytest.mark.parametrize("fps, fading", [(120.0, 1), (600.0, 5)])
def test_of_a_silence_a_network_reads_the_windows_in_which_its_areas_fade(fps, fading):
    calls, table = [], sensor_lookup.build_lookup(VIEWS)

    class Counted(SetNet):
        def forward(self, *given, **options):
            calls.append(options["window_s"])
            return super().forward(*given, **options)

    rule = event_windows.WindowRule(fps=fps, end_s=0.1)
    windows = list(event_windows.cut_windows([moving_then_still()], table, rule))
    list(reconstruct_frames(windows, Counted(channels=4).eval(), VIEWS.positions))
    assert len(calls) == sum(window.events > 0 for window in windows) + fading < len(windows)


@pytest.mark.parametrize("missing", [0, 3, 7])
def test_a_missing_window_leaves_the_states_of_the_others_alone(missing):
    torch.manual_seed(0)
    network, table = E2VID(views=9, base_channels=4).eval(), sensor_lookup.build_lookup(VIEWS)
    rule = event_windows.WindowRule(fps=600.0, frames_per_window=5)
    windows = list(event_windows.cut_windows([recording()], table, rule))
    state = ReconstructionState(5)
    whole = list(reconstruct_frames(windows, network, VIEWS.positions, state))
    left = [window for number, window in enumerate(windows) if number != missing]
    state = ReconstructionState(5)
    found = list(reconstruct_frames(left, network, VIEWS.positions, state))
    others = [frame for number, frame in enumerate(whole) if number != missing]
    for number, (one, other) in enumerate(zip(found, others, strict=True)):
        number += number >= missing
        if number < missing or ((number - missing) % 5 and one.events):
            np.testing.assert_array_equal(one.picture, other.picture)


def test_what_is_run_follows_from_network_and_device():
    network = SetNet(channels=4)
    assert isinstance(
        reconstruction.build_runnable_network(network, "bf16", "cpu", VIEWS, 5), EventListRuntime
    )
    assert isinstance(
        reconstruction.build_runnable_network(FireNet(), "bf16", "cpu", VIEWS, 5), Bf16Network
    )
    with pytest.raises(ValueError, match="bins must be 5 for this network, got 3"):
        reconstruction.build_runnable_network(network, "bf16", "cpu", VIEWS, 3)
    with pytest.raises(ValueError, match="device must be cpu for form=openvino, got cuda"):
        reconstruction.build_runnable_network(network, "openvino", "cuda", VIEWS, 5)


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("cut", [{"fps": 240.0}, {"fps": 600.0, "frames_per_window": 5}])
def test_lists_of_events_backwards_are_the_grids_backwards(name, cut):
    torch.manual_seed(0)
    network, table = NETWORKS[name]().eval(), sensor_lookup.build_lookup(VIEWS)
    span = cut.get("frames_per_window", 1)
    runtime = reconstruction.build_runnable_network(network, "float32", "cpu", VIEWS, 5)
    shown = []
    for grids in (True, False):
        state = ReconstructionState(span)
        rule = event_windows.WindowRule(**cut, as_lists=not grids)
        for windows in (event_windows.cut_windows_backward, event_windows.cut_windows):
            ahead = [0.03] if windows is event_windows.cut_windows_backward else []
            made = windows([recording()], table, rule, *ahead)
            run = network if grids else runtime
            found = list(reconstruct_frames(made, run, VIEWS.positions, state))
            if ahead:
                assert len(found) == {240.0: 7, 600.0: 15}[cut["fps"]]
                state.reverse()
        shown.append(np.stack([frame.picture for frame in found]))
    np.testing.assert_allclose(*shown, atol=1e-5)


def test_view_by_view_the_pictures_are_those_of_each_view_alone():
    torch.manual_seed(0)
    network, table = E2VID(base_channels=4).eval(), sensor_lookup.build_lookup(VIEWS)
    rule = event_windows.WindowRule(fps=600.0, frames_per_window=5)
    first, *others = event_windows.cut_windows([recording()], table, rule)
    windows = [replace(first, events=0, voxels=np.zeros_like(first.voxels)), *others]
    found = list(reconstruction.reconstruct_each_view(windows, network, 5))
    assert (found[0] == 0.5).all() and any(window.events == 0 for window in others)
    for view in range(9):
        alone = [replace(window, voxels=window.voxels[[view]]) for window in windows]
        frames = reconstruct_frames(alone, network, [(0, 0)], ReconstructionState(5))
        pictures = [frame.picture for frame in frames]
        assert np.array_equal([picture[view] for picture in found], pictures)
