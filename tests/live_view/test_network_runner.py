"""What runs live gives the pictures of src.reconstruct, also where windows grow."""

import numpy as np
import pytest
import torch

from src.live_view.live_windows import EventWindow
from src.live_view.network_runner import NetworkRunner, RunSettings, _RecentEvents
from src.models.setnet import SetNet
from src.recordings.event_windows import build_window_rule, cut_windows
from src.recordings.reconstruction import reconstruct_frames
from tests.live_view import scenes

FPS, FRAMES = 6000.0, 12


@pytest.fixture(scope="module")
def windows():
    """The events of every frame, as the intake cuts them."""
    events = scenes.events(0.01)
    ends_us = float(events["t"][0]) + np.arange(FRAMES + 1) * 1e6 / FPS
    cuts = np.searchsorted(events["t"], ends_us)
    return [
        EventWindow(*ends_us[k : k + 2], events[slice(*cuts[k : k + 2])]) for k in range(FRAMES)
    ]


@pytest.mark.parametrize("length", ["frame", None])
def test_live_pictures_are_those_of_reconstruct(length, windows):
    torch.manual_seed(0)
    settings = RunSettings(FPS, window_length=length, form="float32")
    runner = NetworkRunner("net", SetNet(channels=4).eval(), scenes.views(), settings)
    live = [runner.begin(window, restart=not k)() for k, window in enumerate(windows)]
    rule = build_window_rule(length or "growing", fps=FPS, splat="nearest", as_lists=True)
    assert rule.frames_per_window == (1 if length else 2)
    cut = cut_windows([np.concatenate([w.events for w in windows])], runner.lookup, rule)
    runner.network.reset()
    offline = [frame.picture for frame in reconstruct_frames(cut, runner.network)]
    assert len(offline) >= FRAMES - 1
    np.testing.assert_allclose(live[: len(offline)], offline, atol=1e-5)
    assert np.abs(live[-1] - live[0]).max() > 1e-3


def test_windows_grow_on_over_frames_that_are_dropped(windows):
    recent = _RecentEvents(build_window_rule("growing", fps=FPS))
    lengths = []
    for window in [window for k, window in enumerate(windows) if k not in (3, 6, 7)]:
        events, start_us = recent.add(window)
        assert not len(events) or events["t"][0] >= start_us
        lengths.append(round((window.end_us - start_us) * 1e-6 * FPS))
    assert lengths == [1, 2, 1, 3, 1, 1, 2, 1, 2]
