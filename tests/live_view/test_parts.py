"""The parts of the chain by themselves: clocks, cutting, dropping, slices, meters."""

import itertools
import threading
import time
import tracemalloc

import numpy as np
import pytest

from src.live_view import frame_buffer
from src.live_view.feed_reader import MAX_DELAY_S, CameraClock, PlaybackClock
from src.live_view.frame_buffer import (
    MAX_BYTES,
    MAX_FRAMES,
    FrameRing,
    PolarityAccumulator,
    TimeSlice,
)
from src.live_view.live_windows import (
    FEW_LIVE_EVENTS,
    EventWindow,
    WindowCutter,
    WindowQueue,
)
from src.live_view.network_runner import offered_view_counts, positions_used
from src.live_view.status import FaultLog, PipelineCounters
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_order import BUFFER_US
from src.recordings.sensor_lookup import build_lookup
from src.sim.optics import layout
from tests.live_view import scenes

RUNNING = threading.Event()  # never set: nothing is stopped


def some(times, x=1, y=1) -> np.ndarray:
    made = np.zeros(len(times), EVENT)
    made["t"], made["x"], made["y"], made["p"] = times, x, y, 1
    return made


@pytest.fixture
def faults() -> FaultLog:
    return FaultLog()


@pytest.fixture
def cutter(faults) -> WindowCutter:
    return WindowCutter((4, 6), 1000.0, faults)


def window(k: int, starts_scene: bool = False) -> EventWindow:
    return EventWindow(k, k + 1, some([]), starts_scene=starts_scene)


@pytest.mark.parametrize("chunks", [1, 3, 50])
def test_windows_hold_every_event_once_however_it_came(cutter, chunks):
    times = np.sort(np.random.default_rng(0).integers(5_000, 25_000, 400))
    found = []
    for part in np.array_split(some(times), chunks):
        cutter.add(part)
        found += cutter.pop_windows(cutter.last_us)
    for one in found:
        assert ((one.events["t"] >= one.start_us) & (one.events["t"] < one.end_us)).all()
        assert one.end_us - one.start_us == pytest.approx(1000.0)
    assert [one.starts_scene for one in found] == [True] + [False] * (len(found) - 1)
    held = np.concatenate([one.events["t"] for one in found])
    assert np.array_equal(held, times[: len(held)]) and times[-1] - held[-1] <= 1000


def test_a_long_silence_of_a_file_takes_no_memory(faults):
    cutter = WindowCutter((4, 6), 1e5, faults, is_live=False)
    cutter.add(some([0, 30_000_000]))
    tracemalloc.start()
    found = list(itertools.islice(cutter.pop_windows(cutter.last_us), 5000))
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 10**7 and [len(one.events) for one in found] == [1] + [0] * 4999
    assert found[-1].end_us == 50_000


def test_windows_end_where_those_of_reconstruct_do(faults):
    fps, origin = 333.3, 12_345_678
    cutter = WindowCutter((4, 6), fps, faults, is_live=False)
    cutter.add(some([origin, origin + 20_000_000]))
    found = list(cutter.pop_windows(cutter.last_us))
    assert [one.end_us for one in found] == [
        origin + k * 1e6 / fps for k in range(1, len(found) + 1)
    ]
    assert all(one.end_us == two.start_us for one, two in itertools.pairwise(found))


def test_a_window_without_events_is_cut_too(cutter):
    cutter.add(some([0, 10_500]))
    assert [len(one.events) for one in cutter.pop_windows(cutter.last_us)] == [1] + [0] * 9


def test_time_that_jumps_back_starts_anew_and_says_so(cutter, faults):
    cutter.add(some([10**6, 10**6 + 2000]))
    list(cutter.pop_windows(cutter.last_us))
    assert not cutter.add(some(range(FEW_LIVE_EVENTS - 1)))
    assert cutter.add(some([1500]))
    assert any("jumped back by 1 s" in line for line in faults.current())
    (found,) = cutter.pop_windows(cutter.last_us)
    assert found.starts_scene and found.start_us == 0
    assert found.events["t"].tolist() == list(range(FEW_LIVE_EVENTS - 1))


def test_events_a_little_late_are_sorted_and_counted(cutter, faults):
    cutter.add(some([60_000, 100_000]))
    late = 100_000 - BUFFER_US + 15_000
    assert not cutter.add(some([late, 100_500, 100_200, 101_500]))
    found = np.concatenate([one.events["t"] for one in cutter.pop_windows(cutter.last_us)])
    assert found.tolist() == [60_000, late, 100_000, 100_200, 100_500]
    assert faults.current() == ["events came out of order: sorted (2 events)"]


def test_an_event_whose_window_is_over_is_dropped_and_counted(cutter, faults):
    cutter.add(some([0, 5000]))
    assert len(list(cutter.pop_windows(cutter.last_us))) == 5
    cutter.add(some([4999, 6000]))
    (found,) = cutter.pop_windows(cutter.last_us)
    assert found.events["t"].tolist() == [5000]
    assert "events came too late or far out of order: dropped (1 events)" in faults.current()


def test_a_packet_late_as_a_whole_ends_no_stream(cutter, faults):
    cutter.add(some(range(0, 25_000, 500)))
    list(cutter.pop_windows(40_000))
    cutter.add(some([20_000, 21_000, 21_500]))
    assert "events came too late or far out of order: dropped (3 events)" in faults.current()
    cutter.add(some(range(41_000, 60_000, 500)))
    assert sum(len(window.events) for window in cutter.pop_windows(60_000)) == 38


def test_events_in_order_are_dropped_and_counted_when_their_window_is_over(cutter, faults):
    cutter.add(some(range(0, 25_000, 500)))
    list(cutter.pop_windows(40_000))
    cutter.add(some(range(26_000, 31_000, 1000)))
    assert cutter.dropped == 5
    cutter.add(some(range(39_000, 60_000, 500)))
    assert cutter.dropped == 7
    assert sum(len(window.events) for window in cutter.pop_windows(60_000)) == 40
    assert faults.current() == ["events came too late or far out of order: dropped (7 events)"]


def test_a_single_event_after_a_silence_whose_window_is_over_is_counted(cutter, faults):
    cutter.add(some([0]))
    list(cutter.pop_windows(200_000))
    cutter.add(some([100_000]))
    list(cutter.pop_windows(201_000))
    assert faults.current() == ["events came too late or far out of order: dropped (1 events)"]


def test_a_wild_time_moves_no_window(cutter, faults):
    cutter.add(some([0, 500, 3_600_000_000, 700, 1500]))
    (found,) = cutter.pop_windows(cutter.last_us)
    assert found.events["t"].tolist() == [0, 500, 700]
    assert faults.current() == ["events came too late or far out of order: dropped (1 events)"]


def test_events_few_and_far_between_are_not_held_up(cutter):
    cutter.add(some([0]))
    for k in range(1, 5):
        cutter.add(some([k * 100_000]))
        found = [one for one in cutter.pop_windows(k * 100_000 + 1000) if len(one.events)]
        assert [one.events["t"].tolist() for one in found] == [[(k - 1) * 100_000]] * (k == 1) + [
            [k * 100_000]
        ]


def test_events_off_the_sensor_are_left_out_and_counted(cutter, faults):
    cutter.add(some([0, 1, 2], x=[5, 6, 9], y=[3, 3, 4]))
    cutter.add(some([3], x=7))
    assert faults.current() == ["events up to 8x2 are off the 6x4 sensor (3 events)"]
    cutter.add(some([1000]))
    (found,) = cutter.pop_windows(cutter.last_us)
    assert len(found.events) == 1


@pytest.mark.parametrize("fps", [0, -1, float("nan"), 1e6])
def test_an_impossible_rate_is_refused(fps, faults):
    with pytest.raises(ValueError, match="fps must be in"):
        WindowCutter((4, 6), fps, faults)


def test_a_full_backlog_drops_whole_windows_oldest_first():
    backlog = WindowQueue(3)
    for k in range(10):
        backlog.put_within_capacity(window(k, starts_scene=k == 2), RUNNING)
    assert backlog.dropped == 7 and len(backlog) == 3
    found = [backlog.get(0.01) for _ in range(3)]
    assert [one.start_us for one in found] == [7, 8, 9]
    assert [one.starts_scene for one in found] == [
        True,
        False,
        False,
    ]  # the dropped one's word is kept
    assert backlog.get(0.01) is None


def test_a_lossless_backlog_waits_instead():
    backlog, stopped = WindowQueue(2, lossless=True), threading.Event()
    work = threading.Thread(
        target=lambda: [backlog.put_within_capacity(window(k), stopped) for k in range(9)]
    )
    work.start()
    time.sleep(0.05)
    assert len(backlog) == 2
    assert [backlog.get(1.0).start_us for _ in range(9)] == list(range(9))
    work.join(1.0)
    assert backlog.dropped == 0 and not work.is_alive()


def test_a_backlog_has_room_for_one():
    with pytest.raises(ValueError, match="max_waiting_windows must be >= 1"):
        WindowQueue(0)


def test_the_pace_is_that_of_the_recording():
    pace = PlaybackClock(0.5)
    pace.start(10**6)
    _, began = pace.anchor
    assert pace.wait_until_due(10**6 + 20_000, RUNNING) == pytest.approx(began + 0.04, abs=1e-6)
    assert time.perf_counter() - began >= 0.04


def test_a_pause_puts_off_what_comes_after_it():
    pace = PlaybackClock(1.0)
    pace.start(0)
    pace.running.clear()
    threading.Timer(0.15, pace.running.set).start()
    began = time.perf_counter()
    due = pace.wait_until_due(10_000, RUNNING)
    assert began + 0.14 < due <= time.perf_counter()


def test_a_stop_ends_the_wait():
    pace, stopped = PlaybackClock(1.0), threading.Event()
    pace.start(0)
    stopped.set()
    assert pace.wait_until_due(10**9, stopped) is None


@pytest.mark.parametrize("speed", [0, -1, float("nan")])
def test_a_pace_that_stands_is_refused(speed):
    with pytest.raises(ValueError, match="playback_speed must be > 0"):
        PlaybackClock(speed)


def test_a_camera_s_clock_follows_what_came_soonest_and_drifts():
    clock = CameraClock()
    for k in range(1000):  # 10 ms apart, up to 5 ms late, the camera's clock 50 ppm slow
        wall = 100 + k * 0.01 * (1 + 5e-5)
        clock.observe(k * 10_000, wall + 0.005 * ((k * 7) % 10) / 10)
    assert clock.wall_s(10**7) == pytest.approx(110.0005, abs=2e-3)
    assert clock.recorded_us(clock.wall_s(123.0)) == pytest.approx(123.0, abs=1e-3)


def test_a_camera_s_clock_knows_how_late_the_first_events_of_a_packet_come():
    clock = CameraClock()
    for k in range(1, 20):
        clock.observe(20_000 * k, 100 + 0.02 * k, 20_000 * (k - 1))
    assert clock.delay_s == pytest.approx(0.02)
    for k in range(20, 520):
        clock.observe(20_000 * k, 100 + 0.02 * k, 20_000 * k - 1000)
    assert clock.delay_s == pytest.approx(0.001, abs=1e-4)
    clock.observe(10_400_000, 110.4, 0)
    assert clock.delay_s == MAX_DELAY_S


def test_views_to_choose_from():
    assert offered_view_counts(None, layout(9)) == [1, 3, 5, 9]
    assert offered_view_counts(None, layout(4)) == [1, 4]
    assert offered_view_counts(9, layout(9)) == [9]
    assert positions_used(3, layout(9)) == list(layout(3))
    with pytest.raises(ValueError, match="ckpt wants the views"):
        positions_used(9, layout(3))


def test_the_slice_has_a_column_for_every_frame_and_follows_the_line():
    screen = FrameRing((8, 10))
    pictures = np.random.default_rng(0).random((MAX_FRAMES + 50, 8, 10), np.float32)
    cut = TimeSlice(screen)
    cut.line = (0.0, 3.0, 9.0, 3.0)
    shown = []
    for k, picture in enumerate(pictures):
        screen.push(picture)
        if k % 7 == 0:
            shown.append(cut.draw())
    whole = np.rint(pictures * 255).astype(int)
    assert np.array_equal(cut.draw(), whole[-MAX_FRAMES:, 3, :].T)
    assert cut.draw() is None
    cut.line = (2.0, 0.0, 2.0, 7.0)
    assert np.array_equal(cut.draw(), whole[-MAX_FRAMES:, :, 2].T)
    cut.line = (-5.0, -5.0, 20.0, 20.0)  # off the picture: its border
    assert cut.draw().shape == (26, MAX_FRAMES)


def test_the_buffer_is_bounded():
    assert FrameRing((2160, 3840)).ring.nbytes <= MAX_BYTES


def test_the_length_of_the_slice_is_the_wall_time_of_its_frames(monkeypatch):
    frames = frame_buffer.FrameRing((8, 8))
    frames.pushed_s, frames.ring = frames.pushed_s[:4], frames.ring[:4]
    lengths = []
    for now in (10.0, 10.5, 11.0, 14.0, 14.25, 14.5):
        monkeypatch.setattr(frame_buffer.time, "perf_counter", lambda now=now: now)
        frames.push(np.zeros((8, 8), np.float32))
        lengths.append(frames.measure_length_s())
    assert lengths == [None, 0.5, 1.0, 4.0, 3.75, 3.5]


def test_event_pictures_count_where_a_view_looks_and_only_while_watched():
    lookup = build_lookup(scenes.views())
    marks = PolarityAccumulator(lookup)
    y, x = (int(n) for n in np.argwhere(lookup.view == 4)[5000])
    events = some([0, 1], x=x, y=y)
    marks.add(events)
    assert not marks.take().any()
    marks.is_watched = True
    marks.add(events)
    counts = marks.take()
    u, v = np.floor(lookup.model_xy[y, x] + 0.5).astype(int)
    assert counts[4, v, u] == 2 and counts.sum() == 2
    assert not marks.take().any()


def test_events_are_drawn_in_two_colours_and_views_where_they_stand():
    counts = np.zeros((9, 20, 20), np.int32)
    counts[4, :10], counts[0] = 3, -3
    drawn = frame_buffer.draw_events(counts[4])
    assert (drawn[:10] == frame_buffer.ON).all() and (drawn[10:] == frame_buffer.BACKGROUND).all()
    whole = frame_buffer.tile_views_without_gaps(counts, list(layout(9)))
    assert whole.shape == (60, 60, 3)
    assert (whole[:20, :20] == frame_buffer.OFF).all()
    assert (whole[21:30, 21:40] == frame_buffer.ON).all()
    for line in (whole[20], whole[40], whole[:, 20], whole[:, 40]):
        assert (line == frame_buffer.BORDER).all()
    assert (whole != frame_buffer.BORDER).any(-1).sum() == 60**2 - 4 * 60 + 4
    assert (
        max(
            frame_buffer.tile_views_without_gaps(np.zeros((9, 176, 176), np.int32), layout(9)).shape
        )
        <= 264
    )


@pytest.mark.parametrize("size", [(10, 1280), (1280, 10), (1, 2000), (3, 2000), (2, 2)])
def test_views_long_and_narrow_are_drawn(size):
    counts = np.zeros((9, *size), np.int32)
    counts[0] = 3
    drawn = frame_buffer.tile_views_without_gaps(counts, list(layout(9)))
    assert max(drawn.shape) <= 264 and (drawn[0, 0] == frame_buffer.ON).all()
    assert (drawn[-1, -1] == frame_buffer.BACKGROUND).all()


def test_meters_say_rates_and_latency_of_the_last_seconds():
    meters = PipelineCounters(span_s=5.0)
    assert (
        meters.measure_rates_and_latency()["fps"] == 0
        and meters.measure_rates_and_latency()["latency_ms"]["median"] is None
    )
    for k in range(100):
        meters.add_frame(0.001 if k else 0.05, 10)
        time.sleep(0.001)
    rates = meters.measure_rates_and_latency()
    assert rates["latency_ms"]["median"] == 1 and rates["latency_ms"]["p99"] > 1
    assert 0 < rates["fps"] <= 1000
    assert rates["events_per_s"] == pytest.approx(10 * rates["fps"], rel=0.01)
    meters.span_s = 0.001
    time.sleep(0.01)
    assert meters.measure_rates_and_latency()["fps"] == 0


def test_a_fault_goes_when_it_is_over(faults, monkeypatch):
    monkeypatch.setattr("src.live_view.status.SHOWN_S", 0.05)
    faults.report("size", "off the sensor", 3)
    faults.report("camera", "lost", until_cleared=True)
    assert faults.current() == ["off the sensor (3 events)", "lost"]
    time.sleep(0.1)
    assert faults.current() == ["lost"]
    faults.clear("camera")
    assert faults.current() == []
