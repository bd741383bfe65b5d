"""Windows do not depend on how the file is read; states are carried; pictures are held."""

import itertools
import warnings

import numpy as np
import pytest
import torch

from baselines.highpass import HighPass
from src.models.network import EventToVideoNetwork
from src.recordings import event_windows, reconstruction, sensor_lookup, views
from src.recordings.event_windows import WindowRule, build_window_rule
from src.recordings.files.event_file import EVENT
from src.recordings.reconstruction import ReconstructionState, reconstruct_frames
from src.sim.optics import layout

SIZE = (12, 16)
TABLE = sensor_lookup.build_lookup(views.Views.single_view(SIZE, SIZE))


def events(count: int, length_us: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    made = np.zeros(count, EVENT)
    made["t"] = 5_000_000 + np.sort(rng.integers(0, length_us, count))
    made["t"][0], made["t"][-1] = 5_000_000, 5_000_000 + length_us - 1
    made["x"], made["y"] = rng.integers(0, SIZE[1], count), rng.integers(0, SIZE[0], count)
    made["p"] = rng.choice([-1, 1], count)
    return made


def chunks(all_events: np.ndarray, sizes: int):
    return (all_events[k : k + sizes] for k in range(0, len(all_events), sizes))


class Leaky(EventToVideoNetwork):
    """A recurrent stand-in: the state forgets a share of itself per step and adds the events."""

    views = None

    def __init__(self, keep: float = 0.9):
        super().__init__()
        self.keep, self.calls = keep, 0

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        self.window_s, self.positions = window_s, positions
        self.calls += 1
        fresh = voxels.sum((1, 2))[:, None] * 0.05
        state = fresh if state is None else self.keep * state + fresh
        return 0.5 + state, state


RULES = {
    "time": WindowRule(fps=200),
    "overlap": WindowRule(fps=1000, frames_per_window=8),
    "growing": WindowRule(fps=1000, frames_per_window=8, grows=True),
    "cut": WindowRule(fps=200, start_s=0.021, end_s=0.072),
    "edges between microseconds": WindowRule(fps=120),
}


@pytest.mark.parametrize("name", RULES)
@pytest.mark.parametrize("size", [1, 37, 1000])
def test_windows_do_not_depend_on_the_chunks(name, size):
    made, rule = events(4000, 100_000), RULES[name]
    made["t"][100:] = np.maximum(made["t"][100:], 5_008_333)  # many in one, at an edge
    made["t"][100:1000] = 5_008_333
    made = made[np.argsort(made["t"], kind="stable")]
    whole = list(event_windows.cut_windows([made], TABLE, rule))
    parts = list(event_windows.cut_windows(chunks(made, size), TABLE, rule))
    assert len(whole) == len(parts) > 3
    for one, other in zip(whole, parts, strict=True):
        for field in ("start_us", "end_us", "events", "keeps_state"):
            assert getattr(one, field) == getattr(other, field)
        assert np.array_equal(one.voxels, other.voxels)


def test_windows_by_time_share_out_every_event():
    made = events(4000, 100_000)
    found = list(event_windows.cut_windows([made], TABLE, WindowRule(fps=200)))
    assert len(found) == 20
    assert sum(window.events for window in found) == 4000
    assert [window.end_us for window in found] == [5_000_000 + 5000 * k for k in range(1, 21)]


def test_start_and_end_cut_the_recording():
    made = events(4000, 100_000)
    found = list(
        event_windows.cut_windows([made], TABLE, WindowRule(fps=1000, start_s=0.02, end_s=0.03))
    )
    inside = (made["t"] >= 5_020_000) & (made["t"] < 5_030_000)
    assert sum(window.events for window in found) == inside.sum()


def test_each_phase_of_overlapping_windows_counts_an_event_once():
    made = events(4000, 100_000)
    found = list(
        event_windows.cut_windows([made], TABLE, WindowRule(fps=1000, frames_per_window=8))
    )
    for phase in range(8):
        mine = found[phase::8]
        assert all(a.end_us == b.start_us for a, b in itertools.pairwise(mine))
        last = (made["t"] < mine[-1].end_us).sum()
        assert sum(window.events for window in mine) == last


def test_growing_windows_begin_where_the_last_kept_one_ended():
    rule = WindowRule(fps=1000, frames_per_window=8, grows=True)
    made = events(4000, 100_000)
    found = list(event_windows.cut_windows([made], TABLE, rule))
    assert [round(1e3 * window.length_s) for window in found] == ([*range(1, 9)] * 13)[:100]
    assert [window.keeps_state for window in found] == (([False] * 7 + [True]) * 13)[:100]
    for k, window in enumerate(found[8:], start=8):
        assert window.start_us == found[k // 8 * 8 - 1].end_us
    kept = sum(window.events for window in found if window.keeps_state)
    assert kept == (made["t"] < 5_096_000).sum()


@pytest.mark.parametrize("grows", [False, True])
def test_an_event_at_the_edge_of_a_window_is_kept_between_chunks(grows):
    made = np.zeros(20_000, EVENT)  # one a microsecond
    made["t"], made["p"] = np.arange(20_000), 1
    rule = WindowRule(fps=15_000, frames_per_window=5, grows=grows)
    whole = event_windows.cut_windows([made], TABLE, rule)
    parts = event_windows.cut_windows(chunks(made, 7), TABLE, rule)
    assert [one.events for one in whole] == [one.events for one in parts]


def test_a_sum_over_growing_windows_is_that_over_frames():
    made = events(4000, 100_000)
    made["t"][2000:] += 50_000  # a pause
    rule = WindowRule(fps=1000, frames_per_window=8, grows=True)
    np.testing.assert_allclose(
        pictures(made, rule, Sums()), pictures(made, WindowRule(fps=1000), Sums()), atol=1e-5
    )


def test_a_network_looks_back_in_the_longest_of_growing_windows():
    rule = WindowRule(fps=1000, frames_per_window=8, grows=True)
    back = event_windows.cut_windows_backward([events(4000, 100_000)], TABLE, rule, 0.0335)
    assert [round(window.end_us - 5_000_000) for window in back] == [32_000, 24_000, 16_000, 8000]


def test_an_empty_window_takes_no_memory_of_its_own():
    made = np.concatenate([events(10, 1000), events(10, 1000)])
    made["t"][10:] += 1_000_000
    found = list(event_windows.cut_windows([made], TABLE, WindowRule(fps=1000)))
    assert len(found) == 1001
    assert found[500].events == 0 and found[500].voxels.strides == (0, 0, 0, 0)


@pytest.mark.parametrize(
    "made, rule, message",
    [
        (events(100, 1000)[::-1], WindowRule(fps=5000), "backwards"),
        (events(100, 1000), WindowRule(fps=120), "longer than one window of 1/120 s"),
        (np.zeros(0, EVENT), WindowRule(fps=120), "longer than one window"),
    ],
)
def test_a_recording_that_cannot_be_cut_is_refused(made, rule, message):
    with pytest.raises(ValueError, match=message):
        list(event_windows.cut_windows([made], TABLE, rule))


@pytest.mark.parametrize(
    "rule, message",
    [
        ({"start_s": 10}, "start_s must be below the length of the recording, 0.100 s, got 10"),
        ({"start_s": 0.0995}, "leave one window of 1/200 s of the recording, 0.100 s long, got"),
        (
            {"start_s": 0.05, "end_s": 0.051},
            "be at least one window of 1/200 s apart, got 0.05 and",
        ),
        (
            {"end_s": 0.001},
            "end_s must be at least one window of 1/200 s apart, got 0 and 0.001",
        ),
    ],
)
def test_a_part_without_a_window_is_refused_with_what_it_lacks(rule, message):
    with pytest.raises(ValueError, match=message):
        list(event_windows.cut_windows([events(4000, 100_000)], TABLE, WindowRule(200, **rule)))


@pytest.mark.parametrize("end_s, warned", [(0.3, True), (0.1, False), (0.05, False)])
def test_an_end_after_the_last_event_is_told_once(end_s, warned):
    made, rule = events(4000, 100_000), WindowRule(200, end_s=end_s)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = list(event_windows.cut_windows(chunks(made, 700), TABLE, rule))
    assert len(found) == min(20, round(end_s * 200))
    told = "end_s must be at most the length of the recording, 0.100 s, got 0.3"
    assert [str(one.message).startswith(told) for one in caught] == [True] * warned


def test_time_running_backwards_between_chunks_is_refused():
    made = events(100, 10_000)
    with pytest.raises(ValueError, match="backwards"):
        list(event_windows.cut_windows([made[50:], made[:50]], TABLE, WindowRule(fps=5000)))


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"fps": 0}, "fps must be"),
        ({"bins": 0}, "bins must be"),
        ({"fps": 120, "start_s": 2.0, "end_s": 1.0}, "start_s must be"),
    ],
)
def test_a_wrong_rule_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        WindowRule(**wrong)


def pictures(made, rule, network=None, state=None):
    found = event_windows.cut_windows([made], TABLE, rule)
    state = state or ReconstructionState(rule.overlapping_windows)
    frames = reconstruct_frames(found, network or Leaky(), state=state)
    return np.stack([frame.picture for frame in frames])


@pytest.mark.parametrize("overlap", [1, 4])
def test_two_halves_with_the_state_carried_are_the_whole(overlap):
    found = list(
        event_windows.cut_windows(
            [events(4000, 100_000)], TABLE, WindowRule(fps=1000, frames_per_window=overlap)
        )
    )
    network, state = Leaky(), ReconstructionState(overlap)
    alone = reconstruct_frames(found, network, state=ReconstructionState(overlap))
    whole = [frame.picture for frame in alone]
    halves = []
    for part in (found[:37], found[37:]):
        frames = reconstruct_frames(part, network, state=state)
        halves += [frame.picture for frame in frames]
    assert np.array_equal(np.stack(whole), np.stack(halves))


def test_empty_windows_hold_the_picture_and_skip_the_network():
    made = np.concatenate([events(500, 20_000), events(500, 20_000)])
    made["t"][500:] += 1_000_000
    network = Leaky()
    found = pictures(made, WindowRule(fps=1000), network)
    assert network.calls == 40
    assert np.array_equal(found[20:1000], np.repeat(found[19:20], 980, axis=0))


def still_after_motion(noise_hz: float) -> np.ndarray:
    """Return 0.1 s of motion, then 0.5 s of a still scene with `noise_hz` events of the sensor."""
    moving = events(3000, 100_000)
    noise = events(max(2, int(noise_hz * 0.5)), 500_000, seed=1)
    noise["t"] += 100_000
    return np.concatenate([moving, noise])


@pytest.mark.parametrize("noise_hz", [0.0, 2000.0])
def test_a_still_scene_at_12000_fps_fades_no_more_than_at_the_trained_rate(noise_hz):
    made = still_after_motion(noise_hz)
    slow = pictures(made, WindowRule(fps=120))
    fast = pictures(made, build_window_rule("trained", fps=12_000))
    contrast = [found[-1].std() / found[len(found) // 5].std() for found in (slow, fast)]
    assert contrast[1] == pytest.approx(contrast[0], rel=0.15)
    if noise_hz:  # what the rule is for: a window per frame fades to nothing
        naive = pictures(made, WindowRule(fps=12_000))
        assert naive[-1].std() < 0.5 * fast[-1].std()


def test_a_still_scene_at_12000_fps_does_not_flicker():
    fast = pictures(still_after_motion(0.0), build_window_rule("trained", fps=12_000))
    assert np.abs(np.diff(fast[2400:-1], axis=0)).max() == 0  # an event ends the recording


@pytest.mark.parametrize(
    "fps, trained, grown", [(60, 1, 1), (600, 5, 1), (1000, 8, 1), (6000, 50, 3), (12_000, 100, 6)]
)
def test_the_frames_of_a_window(fps, trained, grown):
    rules = [build_window_rule(length, fps=fps) for length in ("frame", "trained", "growing")]
    assert [rule.frames_per_window for rule in rules] == [1, trained, grown]
    assert [rule.overlapping_windows for rule in rules] == [1, trained, 1]


def test_another_span_is_refused():
    with pytest.raises(ValueError, match="window_length must be"):
        build_window_rule("long", fps=120)


@pytest.mark.parametrize("fps", [0, float("nan"), float("inf")])
@pytest.mark.parametrize("length", ["frame", "trained", "growing"])
def test_a_wrong_rate_is_refused_for_any_window(fps, length):
    with pytest.raises(ValueError, match=r"fps must be in \(0, 1e6\]"):
        build_window_rule(length, fps=fps)


def test_a_network_is_given_the_window_and_the_positions():
    network = Leaky()
    found = event_windows.cut_windows([events(400, 10_000)], TABLE, WindowRule(fps=600))
    list(reconstruct_frames(found, network, positions=[(0, 0)]))
    assert network.window_s == pytest.approx(1 / 600) and network.positions == [(0, 0)]


def test_view_by_view_a_network_is_given_the_window_too():
    network = Leaky()
    found = event_windows.cut_windows([events(400, 100_000)], TABLE, WindowRule(fps=60))
    list(reconstruction.reconstruct_each_view(found, network))
    assert network.window_s == pytest.approx(1 / 60) and network.positions == [(0, 0)]


@pytest.mark.parametrize(
    "wants, there, all_views", [(None, 9, True), (9, 9, True), (1, 9, False), (1, 1, True)]
)
def test_a_network_gets_the_views_it_wants(wants, there, all_views):
    network = Leaky()
    network.views = wants
    assert reconstruction.takes_all_views(network, layout(there)) == all_views


def test_a_network_that_looks_at_the_centre_view_gets_no_other():
    centre, median = HighPass(), HighPass(view_reduction="median")
    taken = [reconstruction.takes_all_views(net, layout(9)) for net in (centre, median)]
    assert taken == [False, True]


def test_nine_view_weights_with_one_view_are_refused():
    network = Leaky()
    network.views = 9
    with pytest.raises(ValueError, match="wants 9 views, the recording has 1"):
        reconstruction.takes_all_views(network, layout(1))
    with pytest.raises(ValueError, match="wants 9 views, the recording has 25$"):
        reconstruction.takes_all_views(network, layout(25))  # views= was given
    with pytest.raises(ValueError, match="wants 9 views, views=one.yaml has 1$"):
        reconstruction.takes_all_views(network, layout(1), "one.yaml")


def test_nine_view_weights_take_a_square_alone():
    network = Leaky()
    network.views = 9
    row, wide = [(0, k) for k in range(-4, 5)], [(2 * a, 3 * b) for a, b in layout(9)]
    assert reconstruction.takes_all_views(network, wide)
    with pytest.raises(ValueError, match=r"wants views arranged as .* recording has \[\(0, -4"):
        reconstruction.takes_all_views(network, row)
    network.views = 1
    assert not reconstruction.takes_all_views(network, row)


def test_pictures_are_in_range_for_any_events():
    found = pictures(events(4000, 50_000), WindowRule(fps=100), Leaky(keep=1.0))
    assert found.min() >= 0 and found.max() <= 1 and torch.from_numpy(found).isfinite().all()


class Sums(EventToVideoNetwork):
    """The sum of all events so far, in grey: 0.5 is none."""

    def forward(self, voxels, state=None, **_):
        change = voxels.sum((1, 2))[:, None]
        state = change if state is None else state + change
        return 0.5 + 1e-3 * state, state


@pytest.mark.parametrize("rule", [WindowRule(120), RULES["overlap"], RULES["growing"]])
def test_a_network_looks_back_one_length_of_a_window_at_least(rule):
    back = event_windows.cut_windows_backward([events(4000, 100_000)], TABLE, rule, 1e-4)
    assert len(list(back)) == rule.overlapping_windows


@pytest.mark.parametrize("overlap, size", [(1, 4000), (4, 4000), (4, 100)])
def test_what_looked_ahead_begins_with_what_is_missing_to_there(overlap, size):
    made, rule = (
        events(4000, 100_000),
        WindowRule(fps=1000, frames_per_window=overlap, start_s=0.01),
    )
    once, state = pictures(made, rule, Sums()), ReconstructionState(overlap)
    back = list(event_windows.cut_windows_backward(chunks(made, size), TABLE, rule, 0.0335))
    assert [window.end_us - made["t"][0] for window in back] == [
        1e3 * (10 + k) for k in range(33 // overlap * overlap, 0, -1)
    ]
    for _ in reconstruct_frames(back, Sums(), state=state):
        pass
    state.reverse()
    ahead = pictures(made, rule, Sums(), state)
    there = 33 // overlap * overlap  # the last window of each phase that was looked at
    for k in range(overlap):
        base = once[there - overlap + k] - 0.5
        np.testing.assert_allclose(ahead[k::overlap], once[k::overlap] - base, atol=1e-5)
