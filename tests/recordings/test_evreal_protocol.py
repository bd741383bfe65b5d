"""EVREAL's protocol: which events make a frame, which frames are scored, and how."""

import dataclasses
import itertools

import numpy as np
import pytest

from src.metrics import evreal_scores
from src.models.network import EventToVideoNetwork
from src.recordings.evreal_protocol import (
    EvrealRule,
    check_scored_range,
    cut_evreal_windows,
    fill_evreal_grid,
    score_sequence,
)
from src.recordings.files.evreal_folder import open_sequence
from tests.recordings.files.frames import make_events, make_frames, write_recording

ALL = {"start_s": 0.0, "end_s": 9.0}


class Sum(EventToVideoNetwork):
    """Grey plus a hundredth of all events so far; it keeps what it was given."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def forward(self, voxels, state=None, *, window_s=1 / 120, positions=None):
        self.seen.append((voxels[0, 0].clone(), window_s))
        state = voxels.sum((1, 2))[:, None] + (0 if state is None else state)
        return 0.5 + 0.01 * state, state


@pytest.fixture
def sequence(tmp_path):
    """Return 3000 events from 10 to 100 ms and frames at 0, 30, 60, 90 and 120 ms."""
    return open_sequence(write_recording(tmp_path / "a", "evreal", make_events(), make_frames()))


def image_of(sequence, first, last):
    """Return the sum of the polarities of events (h, w)."""
    image = np.zeros(sequence.size)
    for (x, y), p in zip(sequence.xy[first:last], sequence.p[first:last], strict=True):
        image[y, x] += 1 if p else -1
    return image


def test_windows_between_frames_are_evreals(sequence):
    windows = list(cut_evreal_windows(sequence, EvrealRule()))
    ends = [int((sequence.t <= time).sum()) - 1 for time in (0.03, 0.06, 0.09)]
    # The first window is empty, the last frame has none.
    spans = [(0, 0), (0, ends[0]), (ends[0], ends[1]), (ends[1], ends[2])]
    assert [(w.first_event, w.stop_event) for w in windows] == spans
    assert [w.nearest_camera_frame for w in windows] == [0, 1, 2, 3]
    assert [w.time_s for w in windows] == pytest.approx([0, 0.03, 0.06, 0.09])


def test_windows_of_a_number_of_events(sequence):
    windows = list(cut_evreal_windows(sequence, EvrealRule(window="events", events_per_window=700)))
    assert [(w.first_event, w.stop_event) for w in windows] == [
        (k, k + 700) for k in (0, 700, 1400, 2100)
    ]
    assert [w.time_s for w in windows] == [sequence.t[k + 699] for k in (0, 700, 1400, 2100)]
    nearest = [int(np.abs(sequence.frame_t - w.time_s).argmin()) for w in windows]
    assert [w.nearest_camera_frame for w in windows] == nearest


def test_windows_of_a_length_of_time(sequence):
    windows = list(cut_evreal_windows(sequence, EvrealRule(window="seconds", window_s=0.02)))
    edges = sequence.t[0] + 0.02 * np.arange(5)
    spans = [(int((sequence.t < a).sum()), int((sequence.t < b).sum()))
             for a, b in itertools.pairwise(edges)]  # fmt: skip
    assert [(w.first_event, w.stop_event) for w in windows] == spans
    assert [w.time_s for w in windows] == [sequence.t[last - 1] for _, last in spans]


@pytest.mark.parametrize(
    ("rule", "extra", "frames"),
    [
        ({}, {}, [0, 1, 2, 3]),
        ({}, {"start_s": 0.03, "end_s": 0.06}, [1, 2]),
        ({"window": "seconds", "window_s": 0.01, "tolerance_ms": 1.0}, {}, [1, 2, 3]),
        ({"window": "seconds", "window_s": 0.007, "tolerance_ms": 2.0}, {}, [1, 2]),
    ],
)
def test_which_frames_are_scored(sequence, rule, extra, frames):
    scored = list(score_sequence(sequence, Sum(), EvrealRule(**rule), **(ALL | extra)))
    assert [frame.evreal_window.nearest_camera_frame for frame in scored] == frames


def test_a_network_reads_the_warm_up_and_no_more(sequence):
    for warm_up_s, read in ((10.0, 4), (0.031, 2), (0.0, 1)):
        network = Sum()
        rule = EvrealRule(warm_up_s=warm_up_s)
        (frame,) = score_sequence(sequence, network, rule, start_s=0.09, end_s=0.1)
        assert (len(network.seen), frame.window_index) == (read, 3)


def test_scores_are_those_of_the_pictures(sequence):
    frames = list(score_sequence(sequence, Sum(), EvrealRule(), **ALL))
    expected = (0.5 + 0.01 * image_of(sequence, 0, frames[-1].evreal_window.stop_event)).clip(0, 1)
    assert np.allclose(frames[-1].picture, expected, atol=1e-5)
    truth = make_frames()[3] / 255
    assert frames[-1].scores["mse"] == pytest.approx(np.mean((expected - truth) ** 2), abs=1e-6)
    assert set(frames[-1].scores) == {"mse", "ssim"}


@pytest.mark.parametrize("span", [None, (0.0, 0.2)])
def test_the_grid_is_bilinear_in_time_between_events_or_edges(sequence, span):
    first, last = 40, 900
    start, end = span or (sequence.t[first], sequence.t[last - 1])
    expected = np.zeros((5, *sequence.size))
    for k in range(first, last):
        place = (sequence.t[k] - start) / (end - start) * 4
        for b in range(5):
            share = max(0.0, 1 - abs(place - b))
            expected[b, sequence.xy[k, 1], sequence.xy[k, 0]] += (2.0 * sequence.p[k] - 1) * share
    grid = fill_evreal_grid(sequence, first, last, 5, span)
    assert np.allclose(grid.numpy(), expected, atol=1e-4)


def test_events_of_one_time_are_spread_in_their_order(sequence):
    together = dataclasses.replace(sequence, t=np.zeros(3000))
    grid = fill_evreal_grid(together, 0, 5, 5).numpy()
    for k in range(5):
        x, y = sequence.xy[k]
        assert grid[k, y, x] == pytest.approx(2.0 * sequence.p[k] - 1)
    assert np.abs(grid).sum() == pytest.approx(5)


def test_parts_are_the_same_events_in_equal_lengths(sequence):
    whole, parts = Sum(), Sum()
    rule = {"grid_edges": "window"}
    last = [list(score_sequence(sequence, network, EvrealRule(**rule, max_grid_s=most), **ALL))[-1]
            for network, most in ((whole, None), (parts, 0.01))]  # fmt: skip
    assert np.allclose(last[0].picture, last[1].picture, atol=1e-5)
    assert [len(network.seen) for network in (whole, parts)] == [4, 10]  # 1 + 3 x 3
    assert [window_s for _, window_s in parts.seen[1:]] == pytest.approx([0.01] * 9)
    given = last[1].evreal_window
    inside = (sequence.t[given.first_event : given.stop_event] < 0.07).sum()
    expected = image_of(sequence, given.first_event, given.first_event + inside)
    assert np.allclose(parts.seen[7][0].sum(0).numpy(), expected, atol=1e-4)


def test_output_is_stretched_between_percentiles():
    picture = np.random.default_rng(0).normal(0, 3, (30, 40)).astype(np.float32)
    for kind, (low, high), source in (
        ("robust", (1, 99), picture),
        ("standard", (0, 100), picture),
        ("exprobust", (1, 99), np.exp(picture)),
    ):
        a, b = np.percentile(source, (low, high))
        found = evreal_scores.normalise_output(picture, kind)
        assert np.allclose(found, (source - a) / (b - a), atol=1e-5)
    assert evreal_scores.normalise_output(picture, "none") is picture
    flat = evreal_scores.normalise_output(np.ones((30, 40), np.float32), "robust")
    assert np.isnan(evreal_scores.score_frame(flat, flat, "none", None, "cpu")["mse"])


def test_histograms_of_both_pictures_are_equalised(monkeypatch):
    dark = np.random.default_rng(0).beta(2, 8, (60, 70)).astype(np.float32)
    found = evreal_scores.equalise_histogram(dark, "global")
    assert np.allclose(np.histogram(found, 4, (0, 1))[0] / found.size, 0.25, atol=0.02)
    monkeypatch.setattr(evreal_scores, "LOCAL_RADIUS_PX", 3)
    y, x = 30, 35
    disk = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if i * i + j * j <= 9]
    levels = np.rint(dark * 255)
    below = np.mean([levels[y + i, x + j] <= levels[y, x] for i, j in disk])
    local = evreal_scores.equalise_histogram(dark, "local")
    assert local[y, x] == pytest.approx(below, abs=0.05)
    for kind in ("global", "local", "clahe"):
        assert evreal_scores.score_frame(dark, dark, kind, None, "cpu")["mse"] == 0
        brighter = evreal_scores.score_frame(0.5 * dark, dark, kind, None, "cpu")["mse"]
        assert brighter < np.mean((0.5 * dark) ** 2)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"window": "x"}, "data.window must be one of frames, events, seconds, got x"),
        ({"grid_edges": "x"}, "data.grid_edges must be one of events, window, got x"),
        ({"output_normalisation": "x"}, "data.output_normalisation must be one of none, robust"),
        ({"histogram": "x"}, "data.histogram must be one of none, global, local, clahe, got x"),
        ({"events_per_window": 0}, "data.events_per_window must be > 0, got 0"),
        ({"window_s": -1.0}, "data.window_s must be > 0, got -1"),
        ({"max_grid_s": 0.0}, "data.max_grid_s must be > 0, got 0"),
        ({"tolerance_ms": -1.0}, "data.tolerance_ms must be >= 0, got -1"),
        ({"warm_up_s": -1.0}, "data.warm_up_s must be >= 0, got -1"),
    ],
)
def test_a_rule_out_of_range_is_named(given, words):
    with pytest.raises(ValueError, match=words):
        EvrealRule(**given)


def test_a_range_without_frames_or_events_is_named(tmp_path):
    events = make_events()
    early = events[events["t"] < events["t"][0] + 10_000]
    path = write_recording(tmp_path / "a", "evreal", early, make_frames())
    sequence = open_sequence(path)
    words = r"the events end at 0\.020 s, before 3 of 4 frames between data\.start_s=0 and"
    with pytest.raises(ValueError, match=words):
        check_scored_range(sequence, "frames", 0.0, 9.0)
    check_scored_range(sequence, "seconds", 0.0, 9.0)
    check_scored_range(sequence, "frames", 0.0, 0.03)
    with pytest.raises(
        ValueError, match=r"no frame to score between data\.start_s=5 .*it has 5, up"
    ):
        check_scored_range(sequence, "frames", 5.0, 9.0)
    for name in ("images", "images_ts", "image_event_indices"):
        (path / f"{name}.npy").unlink()
    with pytest.raises(ValueError, match="holds events but no frames"):
        check_scored_range(open_sequence(path), "frames", 0.0, 9.0)


def test_an_event_off_the_sensor_is_named(tmp_path):
    events = make_events()
    events["x"][5] = 48
    path = write_recording(tmp_path / "a", "evreal", events, make_frames())
    with pytest.raises(ValueError, match=r"from event 0 on, .*x in 0\.\.47.*event 5 is x=48"):
        list(score_sequence(open_sequence(path), Sum(), EvrealRule(), **ALL))
