"""What no neighbour supports is taken away, whatever the chunks; edges that move stay."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from baselines.highpass import HighPass
from src.live import assemble_server
from src.live_view.event_feeds import Chunks, Feed
from src.live_view.feed_reader import FeedReader
from src.live_view.live_windows import WindowCutter
from src.live_view.network_runner import RunSettings
from src.live_view.status import FaultLog
from src.recordings.event_windows import WindowRule, cut_windows, cut_windows_backward
from src.recordings.files.event_file import EVENT
from src.recordings.noise_filter import NoiseFilter
from src.recordings.sensor_lookup import build_lookup
from src.recordings.views import Views


def events(*rows: tuple[int, int, int]) -> np.ndarray:
    """Events ON at (t, x, y)."""
    return np.array([(*row, 1) for row in rows], EVENT)


def test_an_event_needs_a_neighbour_and_soon():
    found = NoiseFilter((8, 8), 0.005)(
        events((0, 3, 3), (1000, 4, 4), (1500, 0, 0), (5900, 5, 5), (12_000, 5, 6))
    )
    assert found["t"].tolist() == [1000, 5900]


def test_a_pixel_does_not_support_itself_nor_the_border_the_border():
    hot = events(*((100 * k, 7, 2) for k in range(50)), (5000, 0, 2))
    assert NoiseFilter((8, 8), 0.005)(hot).size == 0


def test_what_came_before_the_clock_jumped_back_supports_nothing():
    keep = NoiseFilter((8, 8), 0.005)
    keep(events((10**7, 3, 3), (10**7 + 10, 4, 4), (10**7 + 20, 6, 6)))
    assert keep(events((1000, 4, 3), (20_000, 2, 2), (30_000, 4, 4), (40_000, 5, 5))).size == 0
    assert keep(events((50_000, 6, 6), (50_100, 6, 5)))["t"].tolist() == [50_100]


def test_a_neighbour_with_a_later_time_hides_no_other():
    keep = NoiseFilter((8, 8), 0.005)
    keep(events((10**7, 2, 2)))
    assert keep(events((1000, 4, 4), (1010, 3, 3)))["t"].tolist() == [1010]


def test_chunks_change_nothing():
    drawer = np.random.default_rng(0)
    many = np.zeros(5000, EVENT)
    many["t"] = np.sort(drawer.integers(0, 100_000, 5000))
    many["x"], many["y"] = drawer.integers(0, 16, (2, 5000))
    whole, parts = NoiseFilter((16, 16), 2e-4), NoiseFilter((16, 16), 2e-4)
    kept = np.concatenate([parts(chunk) for chunk in np.array_split(many, 7)])
    np.testing.assert_array_equal(whole(many), kept)
    assert 0.2 < len(kept) / len(many) < 0.3  # 1 - exp(-8 neighbours x 0.2 ms x 195 a second)


def test_an_edge_that_moves_keeps_its_events_among_noise():
    edge = [(1000 * x, x, y) for x in range(1, 60) for y in range(64)]
    drawer = np.random.default_rng(1)
    noise = [(int(t), int(x), int(y)) for t, x, y in drawer.integers(0, [60_000, 64, 64], (400, 3))]
    kept = NoiseFilter((64, 64), 0.005)(events(*sorted(edge + noise)))
    left = set(map(tuple, kept[["t", "x", "y"]].tolist()))
    assert len(left & set(edge)) > 0.95 * len(edge)
    assert len(left & (set(noise) - set(edge))) < 0.5 * len(noise)


@pytest.mark.parametrize("seconds", [0, -1, 1e30, float("nan"), float("inf")])
def test_a_wrong_time_names_its_key(seconds):
    with pytest.raises(
        ValueError, match=r"noise_filter_s must be in \(0, 1e6\] seconds or null, got"
    ):
        NoiseFilter((8, 8), seconds)


@pytest.mark.parametrize(("x", "y"), [(8, 3), (3, 6), (65_535, 65_535)])
def test_an_event_off_the_sensor_is_refused_and_nothing_written(x, y):
    with pytest.raises(ValueError, match=f"must be on the 8x6 sensor, got x={x}, y={y}"):
        NoiseFilter((6, 8), 0.005)(events((0, 7, 5), (10, x, y)))


def filtered_reader(feed: Feed, faults: FaultLog) -> FeedReader:
    """Return the reader of a page whose feed is filtered, on a sensor of 8x8."""
    server = assemble_server(
        feed, {"net": HighPass()}, Views.single_view((8, 8), (8, 8)),
        RunSettings(100.0, form="float32"), faults, noise_filter_s=0.005,
    )  # fmt: skip
    return server.page.player.reader


class OnePacket(Feed):
    """Sends one chunk of events, live."""

    def __init__(self, packet: np.ndarray):
        self.sensor, self.packet = (8, 8), packet

    def iter_event_chunks(self, stopped: threading.Event) -> Chunks:
        yield self.packet, 0.0


def test_events_of_a_live_feed_off_the_sensor_are_counted_and_not_filtered():
    faults = FaultLog()
    packet = events((0, 3, 3), (500, 60_000, 60_000), (1000, 4, 4), (1100, 4, 8))
    cutter = filtered_reader(OnePacket(packet), faults).cutter
    cutter.add(packet)
    assert [one.events["t"].tolist() for one in cutter.pop_windows(10_000)] == [[1000]]
    assert faults.current() == ["events up to 60001x60001 are off the 8x8 sensor (2 events)"]


def test_a_live_feed_is_filtered_in_the_windows_of_all_its_events():
    seen = events((0, 3, 3), (20_000, 4, 4), (21_000, 3, 4), (49_950, 0, 0))
    cutter = WindowCutter((8, 8), 100.0, FaultLog(), noise_filter=NoiseFilter((8, 8), 0.005))
    for _ in range(2):
        cutter.add(seen)
        found = list(cutter.pop_windows(cutter.last_us))
        assert [one.events["t"].tolist() for one in found] == [[], [], [21_000], []]
        assert [one.start_us for one in found] == [0, 10_000, 20_000, 30_000]
        cutter.restart()


def noise_before_an_edge() -> np.ndarray:
    """Events of one pixel from 0.1 s on, of a moving edge from 0.15 s to 0.2 s."""
    hot = [(100_000 + 5000 * k, 1, 1) for k in range(21)]
    edge = [(150_000 + 1000 * x, 4 + x % 4, y) for x in range(50) for y in range(4, 8)]
    return events(*sorted(hot + edge))


@pytest.mark.parametrize("size", [1, 7, 1000])
@pytest.mark.parametrize("cut", [{}, {"start_s": 0.02, "end_s": 0.08}, {"start_s": 0.09}])
def test_a_filter_moves_no_window(size, cut):
    made, table = noise_before_an_edge(), build_lookup(Views.single_view((8, 8), (8, 8)))
    chunks = [made[k : k + size] for k in range(0, len(made), size)]
    given, kept = [
        list(cut_windows(chunks, table, WindowRule(200.0, noise_filter_s=seconds, **cut)))
        for seconds in (None, 0.005)
    ]
    assert [(one.start_us, one.end_us) for one in given] == [
        (one.start_us, one.end_us) for one in kept
    ]
    left = NoiseFilter((8, 8), 0.005)(made)["t"]
    assert 100 < len(left) < len(made) - 20
    for one in kept:
        assert one.events == ((left >= one.start_us) & (left < one.end_us)).sum()


def test_a_network_looks_back_on_what_is_kept():
    table = build_lookup(Views.single_view((8, 8), (8, 8)))
    rule = WindowRule(200.0, noise_filter_s=0.005)
    back = cut_windows_backward([noise_before_an_edge()], table, rule, 0.06)
    assert [one.events > 0 for one in back] == [True] * 2 + [False] * 10


def test_a_filter_that_keeps_nothing_is_named():
    hot = noise_before_an_edge()[:10]
    table, rule = build_lookup(Views.single_view((8, 8), (8, 8))), WindowRule(200.0)
    assert len(list(cut_windows([hot], table, rule))) == 9
    with pytest.raises(ValueError, match=r"noise_filter_s must leave events, got 0.005, which"):
        next(cut_windows([hot], table, replace(rule, noise_filter_s=0.005)))
