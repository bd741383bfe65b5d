"""The parts of the chain by themselves: pace, cutting, dropping, shedding, slices, meters."""

import threading
import time

import numpy as np
import pytest

from src.live_view import paint, quality
from src.live_view.backlog import Backlog
from src.live_view.cutter import BACK_US, Cutter, EventWindow
from src.live_view.faults import Faults
from src.live_view.meters import Meters
from src.live_view.pace import Pace, StreamClock
from src.live_view.quality import Level, Shedding
from src.live_view.screen import COLUMNS, MOST_BYTES, EventPicture, Screen, Slice
from src.recordings.files.formats import EVENT
from src.recordings.lookup import build
from src.sim.optics import layout
from tests.live_view import scenes

RUNNING = threading.Event()  # never set: nothing is stopped


def some(times, x=1, y=1) -> np.ndarray:
    made = np.zeros(len(times), EVENT)
    made["t"], made["x"], made["y"], made["p"] = times, x, y, 1
    return made


@pytest.fixture
def faults() -> Faults:
    return Faults()


@pytest.fixture
def cutter(faults) -> Cutter:
    return Cutter((4, 6), 1000.0, faults)


def window(k: int, fresh: bool = False) -> EventWindow:
    return EventWindow(k, k + 1, some([]), fresh=fresh)


@pytest.mark.parametrize("chunks", [1, 3, 50])
def test_windows_hold_every_event_once_however_it_came(cutter, chunks):
    times = np.sort(np.random.default_rng(0).integers(5_000, 25_000, 400))
    found = []
    for part in np.array_split(some(times), chunks):
        cutter.add(part)
        found += cutter.windows(cutter.last)
    for one in found:
        assert ((one.events["t"] >= one.start_us) & (one.events["t"] < one.end_us)).all()
        assert one.end_us - one.start_us == pytest.approx(1000.0)
    assert [one.fresh for one in found] == [True] + [False] * (len(found) - 1)
    held = np.concatenate([one.events["t"] for one in found])
    assert np.array_equal(held, times[: len(held)]) and times[-1] - held[-1] <= 1000


def test_a_window_without_events_is_cut_too(cutter):
    cutter.add(some([0, 10_500]))
    assert [len(one.events) for one in cutter.windows(cutter.last)] == [1] + [0] * 9


def test_time_that_jumps_back_starts_anew_and_says_so(cutter, faults):
    cutter.add(some([10**6, 10**6 + 2000]))
    list(cutter.windows(cutter.last))
    assert cutter.add(some([0, 1500]))
    assert "jumped back by 1 s" in faults.now()[0]
    (found,) = cutter.windows(cutter.last)
    assert found.fresh and found.start_us == 0 and found.events["t"].tolist() == [0]


def test_events_a_little_late_are_held_and_counted(cutter, faults):
    cutter.add(some([0, 100_000]))
    assert not cutter.add(some([100_000 - BACK_US, 100_500, 100_200, 101_500]))
    found = np.concatenate([one.events["t"] for one in cutter.windows(cutter.last)])
    assert (np.diff(found) >= 0).all()
    assert faults.now() == ["events came out of order: held (2 events)"]


def test_events_off_the_sensor_are_left_out_and_counted(cutter, faults):
    cutter.add(some([0, 1, 2], x=[5, 6, 9], y=[3, 3, 4]))
    cutter.add(some([3], x=7))
    assert faults.now() == ["events up to 8x2 are off the 6x4 sensor (3 events)"]
    cutter.add(some([1000]))
    (found,) = cutter.windows(cutter.last)
    assert len(found.events) == 1


def test_a_leap_of_the_clock_is_none_within_a_silence(cutter):
    cutter.add(some([0]))
    assert cutter.leaps(some([10**7]), now_us=10**6)
    assert not cutter.leaps(some([10**7]), now_us=9.5e6)


@pytest.mark.parametrize("fps", [0, -1, float("nan"), 1e6])
def test_an_impossible_rate_is_refused(fps, faults):
    with pytest.raises(ValueError, match="fps must be in"):
        Cutter((4, 6), fps, faults)


def test_a_full_backlog_drops_whole_windows_oldest_first():
    backlog = Backlog(3)
    for k in range(10):
        backlog.put(window(k, fresh=k == 2), RUNNING)
    assert backlog.dropped == 7 and len(backlog) == 3
    found = [backlog.get(0.01) for _ in range(3)]
    assert [one.start_us for one in found] == [7, 8, 9]
    assert [one.fresh for one in found] == [True, False, False]  # the dropped one's word is kept
    assert backlog.get(0.01) is None


def test_a_lossless_backlog_waits_instead():
    backlog, stopped = Backlog(2, lossless=True), threading.Event()
    work = threading.Thread(target=lambda: [backlog.put(window(k), stopped) for k in range(9)])
    work.start()
    time.sleep(0.05)
    assert len(backlog) == 2
    assert [backlog.get(1.0).start_us for _ in range(9)] == list(range(9))
    work.join(1.0)
    assert backlog.dropped == 0 and not work.is_alive()


def test_a_backlog_has_room_for_one():
    with pytest.raises(ValueError, match="backlog must be >= 1"):
        Backlog(0)


def test_the_pace_is_that_of_the_recording():
    pace = Pace(0.5)
    pace.start(10**6)
    _, began = pace.anchor
    assert pace.wait(10**6 + 20_000, RUNNING) == pytest.approx(began + 0.04, abs=1e-6)
    assert time.perf_counter() - began >= 0.04


def test_a_pause_puts_off_what_comes_after_it():
    pace = Pace(1.0)
    pace.start(0)
    pace.running.clear()
    threading.Timer(0.15, pace.running.set).start()
    began = time.perf_counter()
    due = pace.wait(10_000, RUNNING)
    assert began + 0.14 < due <= time.perf_counter()


def test_a_stop_ends_the_wait():
    pace, stopped = Pace(1.0), threading.Event()
    pace.start(0)
    stopped.set()
    assert pace.wait(10**9, stopped) is None


@pytest.mark.parametrize("speed", [0, -1, float("nan")])
def test_a_pace_that_stands_is_refused(speed):
    with pytest.raises(ValueError, match="speed must be > 0"):
        Pace(speed)


def test_a_camera_s_clock_follows_what_came_soonest_and_drifts():
    clock = StreamClock()
    for k in range(1000):  # 10 ms apart, up to 5 ms late, the camera's clock 50 ppm slow
        wall = 100 + k * 0.01 * (1 + 5e-5)
        clock.observe(k * 10_000, wall + 0.005 * ((k * 7) % 10) / 10)
    assert clock.wall(10**7) == pytest.approx(110.0005, abs=2e-3)
    assert clock.recorded_us(clock.wall(123.0)) == pytest.approx(123.0, abs=1e-3)


def test_fewer_views_first_then_smaller_networks():
    counts = {"large": [1, 3, 9], "small": [1, 3, 9], "tiny": [1]}
    found = quality.ladder(["large", "small", "tiny"], counts)
    assert [(one.network, one.views) for one in found] == [
        ("large", 9), ("large", 3), ("large", 1), ("small", 1), ("tiny", 1),
    ]  # fmt: skip


def test_views_to_choose_from():
    assert quality.choices(None, layout(9)) == [1, 3, 5, 9]
    assert quality.choices(None, layout(4)) == [1, 4]
    assert quality.choices(9, layout(9)) == [9]
    assert quality.positions(3, layout(9)) == list(layout(3))
    with pytest.raises(ValueError, match="ckpt wants the views"):
        quality.positions(9, layout(3))


def test_shedding_goes_down_before_anything_is_dropped_and_up_when_there_is_time():
    costs = {9: 0.004, 5: 0.003, 3: 0.0018, 1: 0.001}
    shedding = Shedding([Level("net", k) for k in costs], period_s=0.002, room=8)
    now, waiting, most = 0.0, 0.0, 0.0
    for _ in range(3000):  # windows pile up by what the level takes beyond their period
        cost = costs[shedding.level.views]
        now += max(cost, 0.002)
        waiting = max(0.0, waiting + (cost - 0.002) / 0.002)
        most = max(most, waiting)
        shedding.after(cost, int(waiting), now)
    assert shedding.level.views == 3 and most < 8
    costs[9] = costs[5] = 0.0005  # the machine has time again
    for _ in range(30_000):
        now += 0.002
        shedding.after(costs[shedding.level.views], 0, now)
    assert shedding.level.views == 9


def test_the_slice_has_a_column_for_every_frame_and_follows_the_line():
    screen = Screen((8, 10))
    pictures = np.random.default_rng(0).random((COLUMNS + 50, 8, 10), np.float32)
    cut = Slice(screen)
    cut.line = (0.0, 3.0, 9.0, 3.0)
    shown = []
    for k, picture in enumerate(pictures):
        screen.show(picture)
        if k % 7 == 0:
            shown.append(cut.draw())
    whole = np.rint(pictures * 255).astype(int)
    assert np.array_equal(cut.draw(), whole[-COLUMNS:, 3, :].T)
    assert cut.draw() is None
    cut.line = (2.0, 0.0, 2.0, 7.0)
    assert np.array_equal(cut.draw(), whole[-COLUMNS:, :, 2].T)
    cut.line = (-5.0, -5.0, 20.0, 20.0)  # off the picture: its border
    assert cut.draw().shape == (26, COLUMNS)


def test_the_buffer_is_bounded():
    assert Screen((2160, 3840)).ring.nbytes <= MOST_BYTES


def test_event_pictures_count_where_a_view_looks_and_only_while_watched():
    lookup = build(scenes.views())
    marks = EventPicture(lookup)
    y, x = (int(n) for n in np.argwhere(lookup.view == 4)[5000])
    events = some([0, 1], x=x, y=y)
    marks.add(events)
    assert not marks.take().any()
    marks.watched = True
    marks.add(events)
    counts = marks.take()
    u, v = np.floor(lookup.place[y, x] + 0.5).astype(int)
    assert counts[4, v, u] == 2 and counts.sum() == 2
    assert not marks.take().any()


def test_events_are_drawn_in_two_colours_and_views_where_they_stand():
    counts = np.zeros((9, 20, 20), np.int32)
    counts[4, :10], counts[0] = 3, -3
    drawn = paint.events(counts[4])
    assert (drawn[:10] == paint.ON).all() and (drawn[10:] == paint.GROUND).all()
    whole = paint.side_by_side(counts, list(layout(9)))
    assert whole.shape == (60, 60, 3)
    assert (whole[:20, :20] == paint.OFF).all() and (whole[20:30, 20:40] == paint.ON).all()
    assert max(paint.side_by_side(np.zeros((9, 176, 176), np.int32), layout(9)).shape) <= 264


def test_meters_say_rates_and_latency_of_the_last_seconds():
    meters = Meters(span_s=5.0)
    assert meters.rates()["fps"] == 0 and meters.rates()["latency_ms"]["median"] is None
    for k in range(100):
        meters.frame(0.001 if k else 0.05, 10)
        time.sleep(0.001)
    rates = meters.rates()
    assert rates["latency_ms"]["median"] == 1 and rates["latency_ms"]["p99"] > 1
    assert 0 < rates["fps"] <= 1000
    assert rates["events_per_s"] == pytest.approx(10 * rates["fps"], rel=0.01)
    meters.span_s = 0.001
    time.sleep(0.01)
    assert meters.rates()["fps"] == 0


def test_a_fault_goes_when_it_is_over(faults, monkeypatch):
    monkeypatch.setattr("src.live_view.faults.SHOWN_S", 0.05)
    faults.tell("size", "off the sensor", 3)
    faults.tell("camera", "lost", stays=True)
    assert faults.now() == ["off the sensor (3 events)", "lost"]
    time.sleep(0.1)
    assert faults.now() == ["lost"]
    faults.clear("camera")
    assert faults.now() == []
