"""Feeds, the intake that cuts what they give, and the whole chain on a file, without a browser."""

import asyncio
import dataclasses
import json
import re
import socket
import threading
import time
import warnings
from contextlib import asynccontextmanager

import faery
import numba
import numpy as np
import pytest
import torch
from aiohttp import ClientSession, WSMsgType
from numba.core.dispatcher import Dispatcher

from baselines.highpass import HighPass
from src import live
from src.deploy.engines import tiles_numba
from src.live_view import event_feeds, frame_buffer, network_runner
from src.live_view.feed_reader import BEHIND_S, STALL_S, FeedReader, PlaybackClock
from src.live_view.frame_buffer import PolarityAccumulator
from src.live_view.live_windows import (
    FEW_LIVE_EVENTS,
    EventWindow,
    WindowCutter,
    WindowQueue,
)
from src.live_view.network_runner import NetworkRunner, RunSettings
from src.live_view.page_server import PageServer
from src.live_view.status import FaultLog, PipelineCounters
from src.models.setnet import SetNet
from src.recordings import event_windows, noise_filter, reconstruction, sensor_lookup
from src.recordings.files import event_order
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_writers import write_events
from src.recordings.files.recording import read_events
from src.recordings.sensor_lookup import build_lookup
from tests.live_view import scenes
from tests.live_view.browser import free_port, until
from tests.test_recording_entry_points import config


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("live") / "cap.raw"
    height, width = scenes.SENSOR
    write_events(path, scenes.events(0.3), width=width, height=height)
    return str(path)


def received(feed, done) -> np.ndarray:
    """Return what a feed gives until `done` events are there."""
    stopped, found, end = threading.Event(), [], time.monotonic() + 20
    for chunk, _ in feed.iter_event_chunks(stopped):
        found.append(chunk)
        if sum(map(len, found)) >= done or time.monotonic() > end:
            stopped.set()
    return np.concatenate(found)


@pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")  # faery leaves its socket open
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("kind", list(event_feeds.PACKETS))
def test_packets_of_faery_are_read_as_they_were_sent(kind):
    faults, port = FaultLog(), free_port(socket.SOCK_DGRAM)
    sent = np.zeros(3000, faery.EVENTS_DTYPE)
    rng = np.random.default_rng(0)
    sent["t"], sent["on"] = np.sort(rng.integers(0, 2**32, 3000)), rng.random(3000) < 0.5
    sent["x"], sent["y"] = rng.integers(0, 640, 3000), rng.integers(0, 480, 3000)
    feed = event_feeds.open_feed(f"udp://127.0.0.1:{port}", (480, 640), faults, udp_format=kind)
    stream_of = faery.events_stream_from_array(sent, (640, 480))
    sender = threading.Timer(0.2, lambda: stream_of.to_udp(("127.0.0.1", port), format=kind))
    sender.start()
    found = received(feed, 3000)
    sender.join()
    feed.close()
    for name in "txy":
        assert np.array_equal(found[name], sent[name]), name
    assert np.array_equal(found["p"] == 1, sent["on"]) and (abs(found["p"]) == 1).all()
    assert faults.current() == []


def test_the_turn_of_a_32_bit_clock_is_no_jump():
    feed = event_feeds.UdpFeed(
        f"udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}", (4, 4), "t32_x16_y15_on1", FaultLog()
    )
    packed = np.zeros(4, event_feeds.PACKETS["t32_x16_y15_on1"])
    packed["t"] = [2**32 - 2, 2**32 - 1, 0, 5]
    found = np.concatenate([feed.unpack(packed[:3]), feed.unpack(packed[3:])])
    feed.close()
    assert np.diff(found["t"]).tolist() == [1, 1, 5]


@pytest.mark.parametrize(
    ("address", "sensor", "kind", "named"),
    [
        ("udp://127.0.0.1:99999", (4, 4), "t64_x16_y16_on8", "recording must be udp"),
        ("udp://127.0.0.1", (4, 4), "t64_x16_y16_on8", "recording must be udp"),
        ("udp://127.0.0.1:0", None, "t64_x16_y16_on8", "sensor_size must be"),
        ("udp://127.0.0.1:0", (0, 4), "t64_x16_y16_on8", "sensor_size must be"),
        ("udp://127.0.0.1:0", (4, 4), "t8", "udp_format must be one of"),
        ("nowhere.raw", None, "t64_x16_y16_on8", "no such file"),
        ("nowhere.raw", None, "t8", "udp_format must be one of"),
    ],
)
def test_a_feed_that_cannot_be_is_refused(address, sensor, kind, named):
    with pytest.raises(ValueError, match=named):
        event_feeds.open_feed(address, sensor, FaultLog(), udp_format=kind)


def test_a_recording_off_the_given_sensor_is_refused(tmp_path):
    lines = [f"{1e-6 * k} {600 + k % 7} {400 + k % 5} 1" for k in range(50)]
    (tmp_path / "events.txt").write_text("\n".join(lines))
    with pytest.raises(ValueError, match="all 50 events are off the 10x10 sensor"):
        event_feeds.open_feed(str(tmp_path / "events.txt"), (10, 10), FaultLog())


def test_views_of_another_sensor_than_the_recordings_are_refused(tmp_path):
    scenes.views().save(tmp_path / "views.yaml")
    events = scenes.events(0.02)[:200]
    columns = {name: events[name] for name in "tp"} | dict.fromkeys("xy", np.arange(200) % 40)
    given = ["baseline=highpass", f"views={tmp_path}/views.yaml", f"recording={tmp_path}/a.npz"]
    columns["time_unit"] = "us"
    np.savez(tmp_path / "a.npz", **columns, size=[64, 48])
    with pytest.raises(ValueError, match=r"sensor must be .* \(48, 64\), got \(360, 640\)"):
        live.build_server(config("live", tmp_path / "run", *given))
    np.savez(tmp_path / "a.npz", **columns)
    server = live.build_server(config("live", tmp_path / "run", *given))
    assert server.page.player.reader.feed.sensor == scenes.SENSOR == (360, 640)


def test_a_recording_without_events_is_refused(tmp_path):
    np.savez(tmp_path / "none.npz", **dict.fromkeys("txyp", np.zeros(0, np.int64)), size=[64, 48])
    with pytest.raises(ValueError, match="none.npz: holds no events"):
        event_feeds.open_feed(str(tmp_path / "none.npz"), None, FaultLog())


def test_what_is_odd_about_a_file_is_said_when_it_is_opened_and_not_again(recording):
    with pytest.warns(UserWarning, match=r"read as sensor_size=\[500,700\]"):
        feed = event_feeds.open_feed(recording, (500, 700), FaultLog())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert sum(len(chunk) for chunk, _ in feed.iter_event_chunks(threading.Event())) > 1000


def test_a_port_in_use_is_refused():
    first = event_feeds.UdpFeed("udp://127.0.0.1:0", (4, 4), "t64_x16_y16_on8", FaultLog())
    port = first.socket.getsockname()[1]
    with pytest.raises(ValueError, match="recording must be udp"):
        event_feeds.UdpFeed(f"udp://127.0.0.1:{port}", (4, 4), "t64_x16_y16_on8", FaultLog())
    first.close()


class FaeryCamera:
    """What faery's camera looks like: a stream that ends after a packet, as a pulled plug does."""

    def dimensions(self):
        return 640, 480

    def __iter__(self):
        packet = np.zeros(5, faery.EVENTS_DTYPE)
        packet["t"], packet["on"] = np.arange(5), [True, False, True, True, False]
        yield packet


def test_a_camera_is_read_and_looked_for_again_when_it_is_lost(monkeypatch):
    monkeypatch.setattr(faery, "events_stream_from_camera", FaeryCamera)
    monkeypatch.setattr(event_feeds, "RETRY_S", 0.01)
    faults = FaultLog()
    feed = event_feeds.open_feed("camera://", None, faults)
    assert feed.sensor == (480, 640) and feed.is_live
    found = received(feed, 12)
    assert found["p"][:5].tolist() == [1, -1, 1, 1, -1] and len(found) == 15
    assert faults.current() == []


def test_a_camera_of_another_size_is_a_fault_and_is_not_taken(monkeypatch):
    class Larger(FaeryCamera):
        def dimensions(self):
            return 1280, 720

    cameras = iter([FaeryCamera, Larger, Larger, FaeryCamera])
    monkeypatch.setattr(faery, "events_stream_from_camera", lambda: next(cameras)())
    monkeypatch.setattr(event_feeds, "RETRY_S", 0.01)
    faults, said = FaultLog(), []
    monkeypatch.setattr(faults, "report", lambda kind, text, **how: said.append(text))
    found = received(event_feeds.open_feed("camera://", None, faults), 10)
    assert len(found) == 10
    assert said[1:] == 2 * [
        "the camera is lost, looking for it: the sensor must be 640x480 as before, got a camera of"
        " 1280x720"
    ]


def test_an_empty_packet_of_a_camera_does_not_start_a_recording_anew(monkeypatch):
    class Quiet(FaeryCamera):
        def __iter__(self):
            yield np.zeros(0, faery.EVENTS_DTYPE)
            yield from super().__iter__()

    monkeypatch.setattr(faery, "events_stream_from_camera", Quiet)
    feed = event_feeds.open_feed("camera://", None, FaultLog())
    events, _ = next(feed.iter_event_chunks(threading.Event()))
    assert len(events) == 5


def test_no_camera_says_what_to_install():
    with pytest.raises(ValueError, match="pip install event-camera-drivers neuromorphic-drivers"):
        event_feeds.open_feed("camera://", None, FaultLog())


def test_a_file_that_loops_starts_each_time_as_the_first(recording):
    torch.manual_seed(0)
    made = served(recording, {"net": SetNet.preset("small").eval()}, playback_speed=float("inf"))
    player, screen, shown = made.page.player, made.page.frames, []
    player.reader.feed.loop = True
    screen.push = lambda picture: shown.append(picture.copy())
    player.start()
    until(lambda: len(shown) > 110)
    dropped = player.reader.waiting.dropped
    player.stop()
    moving = [k for k in range(20, 40) if np.array_equal(shown[k], shown[0])]
    length = moving[0]
    for k in range(length):
        assert np.array_equal(shown[k], shown[2 * length + k])
    assert player.status()["time_s"] < 0.6 and dropped == 0


class Script(event_feeds.Feed):
    """A live feed that sends what it is told to, when: (seconds from the start, times in us)."""

    sensor = scenes.SENSOR

    def __init__(self, *steps):
        self.steps = steps

    def iter_event_chunks(self, stopped):
        began = time.perf_counter()
        for at, times in self.steps:
            stopped.wait(max(0.0, began + at - time.perf_counter()))
            made = np.zeros(len(times), EVENT)
            made["t"], made["p"] = times, 1
            yield made, time.perf_counter()
        stopped.wait(60)


def live_windows(feed, seconds: float, faults: FaultLog):
    """Return the windows at 100 fps of `seconds` of a live feed, and the intake."""
    marks, meters, waiting = (
        PolarityAccumulator(build_lookup(scenes.views())),
        PipelineCounters(),
        WindowQueue(10_000),
    )
    cutter = WindowCutter(scenes.SENSOR, 100.0, faults)
    intake = FeedReader(feed, cutter, waiting, marks, PlaybackClock(1.0), meters, faults)
    stopped = threading.Event()
    threads = [threading.Thread(target=w, args=(stopped,)) for w in (intake.decode, intake.cut)]
    for thread in threads:
        thread.start()
    time.sleep(seconds)
    state = intake.state
    stopped.set()
    for thread in threads:
        thread.join()
    return list(waiting.windows), state


def test_windows_of_a_quiet_camera_come_by_the_clock_until_it_has_stalled():
    faults = FaultLog()
    windows, state = live_windows(Script((0, [0])), STALL_S + 0.5, faults)
    assert 30 < len(windows) <= 101 * STALL_S and state == "stalled"
    assert "no events for 1 s" in faults.current()[0]
    dues = [one.due_s for one in windows]
    assert np.diff(dues) == pytest.approx(0.01, abs=1e-6)


def test_a_stream_that_comes_back_goes_on_from_there():
    later = 0.2 + STALL_S + 0.3
    feed = Script((0, [0, 200_000]), (later, [9_000_000]), (later + 0.05, [9_050_000]))
    windows, state = live_windows(feed, later + 0.8, FaultLog())
    assert state == "playing"
    starts = np.array([one.start_us for one in windows])
    assert (starts >= 9_000_000).sum() >= 3 and not ((starts > 1.5e6) & (starts < 9e6)).any()
    assert [one.starts_scene for one in windows].count(True) == 1  # the picture is not thrown away


def test_a_stream_that_comes_back_with_an_earlier_clock_starts_anew_and_says_so():
    later, faults = 0.1 + STALL_S + 0.3, FaultLog()
    feed = Script((0, [9_000_000]), (0.1, [9_100_000]), *packets(later, 0, 40))
    windows, _ = live_windows(feed, later + 0.4, faults)
    assert [one.starts_scene for one in windows].count(True) == 2
    assert "time jumped back by 9.1 s: started anew" in faults.current()


def packets(at_s: float, first_us: int, count: int, length_us: int = 5000) -> list:
    """Return steps of a Script: packets one after the other, each sent at its end."""
    return [
        (at_s + (k + 1) * length_us * 1e-6, range(start, start + length_us, 500))
        for k, start in enumerate(range(first_us, first_us + count * length_us, length_us))
    ]


def all_in_their_windows(windows) -> bool:
    """Return whether every event lies in the window that holds it."""
    return all(
        ((one.events["t"] >= one.start_us) & (one.events["t"] < one.end_us)).all()
        for one in windows
    )


def test_a_stream_that_falls_behind_starts_anew_and_says_so():
    faults = FaultLog()
    feed = Script(*packets(0, 0, 40), *packets(0.7, 200_000, 160))
    windows, _ = live_windows(feed, 1.5, faults)
    assert all_in_their_windows(windows)
    assert any("dropped" in line for line in faults.current())
    assert f"events came too late for {BEHIND_S:g} s: started anew" in faults.current()
    assert [one.starts_scene for one in windows].count(True) >= 2
    assert sum(len(one.events) > 0 for one in windows[-30:]) > 15


def test_packets_longer_than_a_window_lose_no_event():
    faults = FaultLog()
    windows, _ = live_windows(Script(*packets(0, 0, 20, 40_000)), 1.0, faults)
    assert all_in_their_windows(windows)
    assert sum(len(one.events) for one in windows) >= 19 * 80
    assert faults.current() == []


def test_a_camera_s_clock_that_leaps_does_not_make_windows_without_end():
    feed = Script((0, [0]), (0.1, [10**12]), (0.15, [10**12 + 50_000]))
    windows, _ = live_windows(feed, 0.4, FaultLog())
    assert len(windows) < 60
    assert sum(one.start_us >= 10**12 for one in windows) >= 4


def quiet(at_s: float, count: int, shift_s: float = 0.0) -> list:
    """Return chunks of one event each, 2 ms apart, sent at once; their clock is `shift_s` off."""
    sent = (at_s + 0.002 * np.arange(count)).tolist()
    return [(at, [round((at + shift_s) * 1e6)]) for at in sent]


def cut_quiet(*chunks):
    """Return the windows at 200 fps of live chunks (wall s, times in us, x) and the faults."""
    faults, never, waiting = FaultLog(), threading.Event(), WindowQueue(10_000)
    marks, cutter = (
        PolarityAccumulator(build_lookup(scenes.views())),
        WindowCutter(scenes.SENSOR, 200.0, faults),
    )
    parts = waiting, marks, PlaybackClock(1.0), PipelineCounters(), faults
    intake = FeedReader(Script(), cutter, *parts)
    for at, times, *x in chunks:
        made = np.zeros(len(times), EVENT)
        made["t"], made["x"], made["p"] = times, x[0] if x else 5, 1
        intake._cut_live((made, at), at, never)
    windows = list(waiting.windows)
    return windows, [one.starts_scene for one in windows].count(True), faults.current()


DROPPED = "events came too late or far out of order: dropped ({} events)"


@pytest.mark.parametrize("count", [1, 3, FEW_LIVE_EVENTS - 1])
@pytest.mark.parametrize("shift_s", [50.0, -50.0])
def test_few_wild_times_alone_in_a_chunk_are_dropped_and_forget_no_scene(count, shift_s):
    wild = (1.5, [round((1.5 + shift_s) * 1e6)] * count)
    windows, begun, faults = cut_quiet(*quiet(1.0, 250), wild, *quiet(1.502, 250))
    assert begun == 1 and faults == [DROPPED.format(count)]
    assert sum(len(one.events) for one in windows) >= 495


def test_wild_times_of_one_clock_alone_are_a_jump():
    rng = np.random.default_rng(0)
    wild = [(1.5 + 0.002 * k, [int(rng.integers(10**8, 10**12))]) for k in range(40)]
    windows, begun, faults = cut_quiet(*quiet(1.0, 250), *wild, *quiet(1.58, 250))
    assert begun == 1 and faults == [DROPPED.format(40)] and len(windows) < 220


def test_a_stale_event_after_a_silence_ends_no_scene_and_no_silence():
    later = 1.5 + STALL_S + 0.2
    windows, begun, faults = cut_quiet(*quiet(1.0, 250), (later, [10]), *quiet(later + 0.002, 250))
    assert begun == 1 and faults == [DROPPED.format(1)] and len(windows) < 200


@pytest.mark.parametrize(
    ("pause_s", "shift_s", "scenes_begun", "said"),
    [
        (0.0, 50.0, 1, []),
        (0.0, -50.0, 2, ["time jumped back by 50 s: started anew"]),
        (1.2, -50.0, 2, ["time jumped back by 48.8 s: started anew"]),
    ],
)
def test_a_clock_that_jumps_in_a_quiet_scene_restarts_time(pause_s, shift_s, scenes_begun, said):
    after = quiet(101.5 + pause_s, 250, shift_s)
    windows, begun, faults = cut_quiet(*quiet(101.0, 250), *after)
    times = np.concatenate([one.events["t"] for one in windows])
    jumped = times[np.abs(times - after[0][1][0]) < 10**6]
    assert begun == scenes_begun and faults == said
    assert len(windows) < 220 and len(jumped) > 200 and jumped[0] == after[0][1][0]


def test_events_off_the_sensor_alone_restart_nothing():
    off = [(at, times, scenes.SENSOR[1] + 7) for at, times in quiet(1.2, 250)]
    windows, begun, faults = cut_quiet(*quiet(1.0, 100), *off, *quiet(1.7, 250))
    assert begun == 1 and faults == ["events up to 648x1 are off the 640x360 sensor (250 events)"]
    assert sum(len(one.events) for one in windows) >= 345 and len(windows) > 235


def test_what_comes_live_is_not_slowed_down():
    parts = (WindowQueue(1), PolarityAccumulator(build_lookup(scenes.views())), PlaybackClock(0.5))
    with pytest.raises(ValueError, match="playback_speed must be 1 for what comes live"):
        FeedReader(
            Script(),
            WindowCutter(scenes.SENSOR, 100.0, FaultLog()),
            *parts,
            PipelineCounters(),
            FaultLog(),
        )


def served(recording: str, networks, **how) -> PageServer:
    """Return the server of a recording, its port open to be chosen."""
    views, faults = scenes.views(), FaultLog()
    running = RunSettings(how.pop("fps", 100.0), form="float32")
    feed = event_feeds.open_feed(recording, None, faults)
    made = live.assemble_server(feed, networks, views, running, faults, port=free_port(), **how)
    made.page.controls.choose(next(iter(networks)), "all")
    return made


def test_as_fast_as_it_goes_every_picture_is_that_of_reconstruct(recording):
    torch.manual_seed(0)
    network = SetNet.preset("small").eval()
    made = served(recording, {"net": network}, playback_speed=float("inf"))
    player, screen = made.page.player, made.page.frames
    player.start()
    until(lambda: player.reader.state == "ended" and not len(player.reader.waiting))
    until(lambda: screen.count >= 29)
    player.stop()
    rule = event_windows.WindowRule(fps=100.0, splat="nearest")
    windows = event_windows.cut_windows(
        [read_events(recording)], build_lookup(scenes.views()), rule
    )
    frames = reconstruction.reconstruct_frames(windows, network, scenes.views().positions)
    wanted = np.array([np.rint(frame.picture * 255) for frame in frames])
    assert player.reader.waiting.dropped == 0
    shown = screen.ring[: screen.count].astype(float)
    assert np.abs(shown - wanted[: screen.count]).max() <= 1 and shown.std() > 1
    assert len(wanted) - screen.count in (0, 1)


def test_a_recording_shorter_than_a_window_is_said_so(tmp_path):
    height, width = scenes.SENSOR
    write_events(tmp_path / "a.npz", scenes.events(0.01)[:1], width=width, height=height)
    player = served(str(tmp_path / "a.npz"), {"net": SetNet.preset("small").eval()}).page.player
    player.start()
    until(lambda: player.reader.state == "ended")
    player.stop()
    line = "recording must be longer than one window of 1/100 s, got 0 s"
    assert player.reader.faults.current() == [line]


def test_a_silence_is_that_of_the_network_on_every_window():
    rng, made = np.random.default_rng(0), np.zeros(3100, EVENT)
    noise = rng.choice(np.arange(120_000, 160_000), 100)
    made["t"] = np.sort(np.r_[0, rng.choice(20_000, 2999), noise])
    height, width = scenes.SENSOR
    made["x"], made["y"] = rng.integers(0, width, 3100), rng.integers(0, height // 3, 3100)
    made["p"] = rng.integers(0, 2, 3100) * 2 - 1
    torch.manual_seed(0)
    settings = RunSettings(fps=600.0, form="float32")
    runner = NetworkRunner("net", SetNet(channels=4).eval(), scenes.views(), settings)
    rule = dataclasses.replace(runner.rule, as_lists=True)
    shown, every = [], runner.network
    for number in range(95):
        start_us, end_us = number * 1e6 / 600, (number + 1) * 1e6 / 600
        cut = made[(made["t"] >= start_us) & (made["t"] < end_us)]
        shown.append(runner.begin(EventWindow(start_us, end_us, cut), restart=number == 0)())
    every.reset()
    windows = event_windows.cut_windows([made], build_lookup(scenes.views()), rule)
    wanted = [every.step(*one.event_list, 0.0, one.length_s) for one in windows][:95]
    np.testing.assert_allclose(shown, wanted, atol=1e-5)
    assert np.ptp(shown[11:20], 0).max() > 1e-4 and not np.ptp(shown[30:60], 0).any()


def test_the_recorded_time_is_that_of_the_frame_shown_also_while_nothing_moves(recording, tmp_path):
    events = read_events(recording)
    start_us = int(events["t"][0])
    events["t"][events["t"] > start_us + 100_000] += 8_000_000
    height, width = scenes.SENSOR
    write_events(tmp_path / "still.raw", events, width=width, height=height)
    made = served(str(tmp_path / "still.raw"), {"net": HighPass()})
    player, screen = made.page.player, made.page.frames
    assert player.status()["time_s"] is None
    player.start()
    until(lambda: screen.count >= 30)
    count, status = screen.count, player.status()
    player.stop()
    assert count / 100 - 1e-3 <= status["time_s"] - start_us * 1e-6 < 5  # the next event: at 8 s
    assert np.array_equal(screen.ring[20], screen.ring[29])


def test_windows_that_overlap_are_those_of_reconstruct_to_the_event():
    fps, origin = 1200.0, 1_000_003  # every third frame ends at a whole microsecond
    times = np.arange(origin, origin + 100_000, 5)
    made = np.zeros(len(times), EVENT)
    made["t"], made["x"], made["y"], made["p"] = times, 320, 180, 1
    settings = RunSettings(fps, window_length="trained", form="float32")
    runner = NetworkRunner("net", HighPass(), scenes.views(), settings)
    rule = event_windows.build_window_rule("trained", fps=fps, splat="nearest")
    wanted = event_windows.cut_windows([made], build_lookup(scenes.views()), rule)
    cutter = WindowCutter(scenes.SENSOR, fps, FaultLog(), is_live=False)
    cutter.add(made)
    for k, (window, one) in enumerate(
        zip(cutter.pop_windows(float(times[-1])), wanted, strict=False)
    ):
        filled = runner.begin(window, restart=k == 0).args[0]
        assert (filled.events, filled.end_us) == (one.events, one.end_us), k
        assert filled.start_us == one.start_us or one.start_us < origin, k
    assert k > 100


def test_live_windows_do_not_grow():
    settings = RunSettings(12_000.0, window_length="growing", form="float32")
    with pytest.raises(ValueError, match="must be frame or trained for `.*live`, got growing"):
        NetworkRunner("net", SetNet.preset("small"), scenes.views(), settings)


def test_kernels_are_loaded_before_the_first_events(recording, monkeypatch):
    run = set()
    for module, name in (
        (frame_buffer, "count_polarity"),
        (noise_filter, "mark_supported_events"),
        (event_order, "label_kept_or_dropped"),
    ):
        kernel = getattr(module, name)
        spy = lambda *given, kernel=kernel, name=name: run.add(name) or kernel(*given)  # noqa: E731
        monkeypatch.setattr(module, name, spy)
    made = served(recording, {"net": HighPass()}, noise_filter_s=0.01)
    reader = made.page.player.reader
    assert run == {"count_polarity", "mark_supported_events", "label_kept_or_dropped"}
    assert reader.cutter.origin_us is None and reader.cutter.starts_scene
    assert not reader.faults.current() and not reader.counter.windows
    reader.feed.close()


@pytest.fixture
def kernel_types(monkeypatch):
    """The types of what kernels are called with, each of which numba compiles for."""
    found = set()
    for module in (tiles_numba, sensor_lookup, frame_buffer, noise_filter):
        for name, kernel in vars(module).copy().items():
            if isinstance(kernel, Dispatcher):

                def spy(*given, kernel=kernel, name=name):
                    found.add((name, *map(str, map(numba.typeof, given))))
                    return kernel(*given)

                monkeypatch.setattr(module, name, spy)
    return found


def local_and_other_windows() -> list[np.ndarray]:
    """Return windows of no event, one, few, in one place again and again, and everywhere."""
    rng, (height, width) = np.random.default_rng(0), scenes.SENSOR
    windows = [np.zeros(count, EVENT) for count in (0, 1, 60, *[500] * 25, 20_000, 1, 0)]
    for events in windows:
        side = 20 if 1 < len(events) < 1000 else height
        events["x"] = (width - side) // 2 + rng.integers(0, side, len(events))
        events["y"] = (height - side) // 2 + rng.integers(0, side, len(events))
        events["p"] = rng.choice([-1, 1], len(events))
    return windows


def test_a_runner_has_compiled_all_kernels_when_it_is_made(kernel_types):
    net, settings = SetNet.preset("small").eval(), RunSettings(600.0, form="float32")
    runner = NetworkRunner("net", net, scenes.views(), settings)
    counter, keep = PolarityAccumulator(runner.lookup), noise_filter.NoiseFilter(scenes.SENSOR, 1.0)
    counter.is_watched = True

    def run(events: np.ndarray, *, restart: bool) -> None:
        counter.add(keep(events))
        runner.begin(EventWindow(0.0, 1e6 / 600, events), restart=restart)()

    run(np.zeros(50, EVENT), restart=True)
    before = kernel_types.copy()
    for events in local_and_other_windows():
        run(events, restart=False)
    assert {"scatter", "gather_interpolated"} <= {name for name, *_ in before}
    assert kernel_types == before


def test_loads_are_cpu_time_not_waits(recording):
    class Waiting(HighPass):
        def forward(self, *args, **kwargs):
            time.sleep(0.05)
            return super().forward(*args, **kwargs)

    made = served(recording, {"waiting": Waiting()}, max_waiting_windows=4)
    player = made.page.player
    player.start()
    until(lambda: player.frames.count >= 5)
    player.stop()
    assert player.meters.busy_s["network"] < 0.05 * player.frames.count / 2


def test_what_cannot_keep_up_drops_windows_and_keeps_its_latency(recording):
    class Slow(HighPass):
        def forward(self, *args, **kwargs):
            time.sleep(0.05)
            return super().forward(*args, **kwargs)

    made = served(recording, {"slow": Slow()}, fps=400.0, max_waiting_windows=4)
    player = made.page.player
    player.start()
    until(lambda: player.reader.state == "ended")
    status = player.status()
    player.stop()
    player.reader.state = "playing"
    hint = r"fps=(\d+) or less \(of recorded time\) drops fewer; longer windows take longer"
    fps = int(re.fullmatch(hint, player.status()["hint"])[1])
    assert 0 < fps < 30
    assert status["dropped"] > 50 and status["waiting"] <= 4
    assert status["latency_ms"]["median"] < 2000  # four windows and the network, on a busy machine


def test_a_file_that_breaks_off_is_told(recording, tmp_path, monkeypatch):
    def broken(*args):
        yield read_events(recording)[:1000]
        raise ValueError(f"{recording}: cannot be decoded: broken")

    monkeypatch.setattr(event_feeds, "cut_chunks", broken)
    made = served(recording, {"net": HighPass()})
    made.page.player.start()
    until(lambda: made.page.player.status()["state"] == "broken")
    assert "cannot be decoded" in made.page.player.status()["faults"][0]
    made.page.player.stop()


NONSENSE = (
    '{"line": [0, 0, 87, 87]}',
    "no json",
    "[1]",
    '{"line": ["a"]}',
    '{"network": "other"}',
    '{"line": [1' + "0" * 400 + ", 0, 0, 0]}",
    "[" * 4000,
    '{"network": "net", "views": 77}',
)


async def _header(socket) -> dict:
    """Return the header of the next message, which is whole; say that it came."""
    message = await socket.receive(timeout=20)
    await socket.send_str("received")
    assert message.type == WSMsgType.BINARY
    length = int.from_bytes(message.data[:4], "little")
    header = json.loads(message.data[4 : 4 + length])
    assert len(message.data) - 4 - length == sum(size for _, size in header["pictures"])
    return header


def test_the_server_answers_and_takes_only_what_makes_sense(recording):
    made = served(recording, {"net": HighPass()}, fps=200.0)

    async def visit() -> list[dict]:
        stop = asyncio.Event()
        running = asyncio.create_task(made.run(made.page.player.start, stop))
        async with ClientSession(f"http://127.0.0.1:{made.port}") as session:
            await asyncio.sleep(0.5)
            assert "<canvas" in await (await session.get("/")).text()
            async with session.ws_connect("/stream") as socket:
                for asked in NONSENSE:
                    await socket.send_str(asked)
                headers = [await _header(socket) for _ in range(24)]
        stop.set()
        await running
        return headers

    answers = asyncio.run(visit())
    made.page.player.stop()
    headers = [answer["status"] for answer in answers if "status" in answer]
    assert headers[-1]["line"] == [0, 0, 87, 87] and headers[-1]["chosen"]["network"] == "net"
    refused = [answer["refused"] for answer in answers if "refused" in answer]
    assert any("views_used must be one of" in line for line in refused)
    assert not any(one["faults"] for one in headers)  # which all visitors see


@asynccontextmanager
async def visiting(made: PageServer):
    """Serve, without playing; yield a visitor's socket."""
    stop = asyncio.Event()
    running = asyncio.create_task(made.run(lambda: None, stop))
    await asyncio.sleep(0.2)
    base = f"http://127.0.0.1:{made.port}"
    async with ClientSession(base) as session, session.ws_connect("/stream") as socket:
        yield socket
    stop.set()
    await running


async def until_true(condition) -> None:
    """Wait until `condition`, at most 20 s."""
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        await asyncio.sleep(0.02)


def test_a_visitor_who_takes_little_sees_the_newest_in_the_third_message(page_server):
    page = page_server.page

    async def visit() -> list[dict]:
        async with visiting(page_server) as socket:
            for _ in range(40):
                show_frame(page)
                await asyncio.sleep(1 / 30)
            await socket.send_str('{"pause": true}')
            await asyncio.sleep(1.0)
            return [await _header(socket) for _ in range(3)]

    headers = asyncio.run(visit())
    assert [name for name, _ in headers[2]["pictures"]] == ["frame", "events", "slice"]
    assert headers[2]["status"]["paused"] and headers[2]["status"]["slice_s"] > 1.0


def test_who_answers_more_than_was_sent_gets_no_more_at_a_time(page_server):
    async def visit() -> list[dict]:
        async with visiting(page_server) as socket:
            for _ in range(10):
                await socket.send_str("received")
            await asyncio.sleep(1.5)  # in which there are five readings of the meters
            page_server.page.handle_request({"pause": True})
            await asyncio.sleep(0.5)
            return [await _header(socket) for _ in range(5)]

    headers = asyncio.run(visit())
    assert not any("refused" in header for header in headers)
    assert headers[4]["status"]["paused"]


def test_a_pause_does_not_wait_for_a_network_that_is_made_ready(page_server, monkeypatch):
    page, is_ready = page_server.page, threading.Event()

    def prepare(*given):
        assert is_ready.wait(20)
        return NetworkRunner(*given)

    monkeypatch.setattr(network_runner, "NetworkRunner", prepare)

    async def visit() -> None:
        async with visiting(page_server) as socket:
            for asked in ({"network": "net", "views": 1}, {"pause": True}, {"all_views": True}):
                await socket.send_str(json.dumps(asked))
            await until_true(lambda: page.all_views and page.status()["paused"])
            await until_true(lambda: page.status()["preparing"] == {"network": "net", "views": 1})
            assert page.status()["chosen"]["views"] == 9
            is_ready.set()
            await until_true(lambda: page.status()["chosen"]["views"] == 1)
            assert page.status()["preparing"] is None

    asyncio.run(visit())


@pytest.mark.parametrize("asked", ["no json", "[1]", "[" * 4000])
def test_a_request_that_is_no_json_object_is_told_what_one_is(page_server, asked):
    async def visit() -> str:
        async with visiting(page_server) as socket:
            await socket.send_str(asked)
            while "refused" not in (header := await _header(socket)):
                pass
            return header["refused"]

    shown = asked if len(asked) < 40 else "[" * 40 + "..."
    wanted = 'a request must be a JSON object such as {"pause": true}'
    assert asyncio.run(visit()) == f"{wanted}, got {shown}"


def test_the_hint_goes_when_no_window_is_dropped_any_more(page_server):
    player, shown = page_server.page.player, np.zeros((88, 88), np.float32)
    player.reader.state, player.meters.span_s = "playing", 0.5

    def show_window() -> None:
        count = player.frames.count
        player.begun.put((EventWindow(0.0, 1.0, np.zeros(1, EVENT)), lambda: shown, None))
        until(lambda: player.frames.count > count and not player.begun.qsize())

    thread = threading.Thread(target=player.run_network, args=(player.stopped,))
    thread.start()
    player.reader.waiting.dropped = 7
    for _ in range(5):
        show_window()
    until(lambda: player.status()["hint"] is not None)
    time.sleep(0.6)
    for _ in range(5):
        show_window()
    until(lambda: player.status()["fps"] > 0)
    status = player.status()
    player.stopped.set()
    thread.join()
    assert status["hint"] is None and status["dropped"] == 7


def pictures(message: bytes | None) -> list[str]:
    """Return the names of a message's pictures."""
    assert message is not None
    length = int.from_bytes(message[:4], "little")
    return [name for name, _ in json.loads(message[4 : 4 + length])["pictures"]]


@pytest.fixture
def page_server(recording):
    made = served(recording, {"net": HighPass()})
    made.page.counter.is_watched = True
    yield made
    made.page.player.reader.feed.close()


def show_frame(page) -> None:
    """Show a frame of a window with an event."""
    events = np.zeros(1, EVENT)
    page.frames.push(np.full(page.frames.size, 0.5, np.float32))
    page.counter.add(events)


def test_a_slow_visitor_gets_the_last_frame(page_server):
    page, slow, quick = page_server.page, asyncio.Queue(1), asyncio.Queue(1)
    page_server.visitors |= {slow, quick}
    show_frame(page)
    page_server._hand_out(page.message())
    assert pictures(quick.get_nowait()) == ["frame", "events", "slice"]
    page.status_sent = -np.inf  # nothing new but the status
    page_server._hand_out(page.message())
    assert pictures(quick.get_nowait()) == []
    assert pictures(slow.get_nowait()) == ["frame", "events", "slice"]


def test_who_comes_takes_nothing_from_those_who_are_there(page_server):
    page = page_server.page
    show_frame(page)
    assert pictures(page.message()) == ["frame", "events", "slice"]
    show_frame(page)
    before = page.status_sent
    assert pictures(page.message(whole=True)) == ["frame", "events", "slice"]
    assert page.status_sent == before
    assert pictures(page.message()) == ["frame", "events", "slice"]
    assert page.message() is None


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"pause": "no"}, "pause must be true or false, got no"),
        ({"all_views": 1}, "all_views must be true or false, got 1"),
        ({"one_view": None}, "one_view must be true or false, got None"),
        ({"pause": True, "tone": "bad"}, "tone must be auto or none, got bad"),
        ({"pause": True, "all_views": True, "line": [0]}, "line must be x0, y0, x1, y1"),
        ({"pause": True, "network": "net", "views": 77}, "views_used must be one of"),
        ({"pause": True, "views": 5}, "views must come with network, got views=5 alone"),
        ({"pause": True, "paws": 1}, "a request must be of pause, .*, got paws"),
    ],
)
def test_a_request_of_which_a_part_makes_no_sense_does_nothing(page_server, wrong, words):
    page = page_server.page
    with pytest.raises(ValueError, match=words):
        page.handle_request(wrong)
    assert not page.player.status()["paused"] and not page.all_views
    page.handle_request({"pause": True, "network": "net", "views": "all"})
    assert page.player.status()["paused"]


def test_pictures_that_cannot_be_drawn_are_a_fault_and_the_page_goes_on(recording, monkeypatch):
    def fail(*args):
        raise ZeroDivisionError("no pixels")

    made = served(recording, {"net": HighPass()}, fps=200.0)
    monkeypatch.setattr("src.live_view.page_server.draw_events", fail)

    async def visit() -> list[dict]:
        stop = asyncio.Event()
        running = asyncio.create_task(made.run(made.page.player.start, stop))
        await asyncio.sleep(0.5)
        address = f"http://127.0.0.1:{made.port}/stream"
        async with ClientSession() as session, session.ws_connect(address) as socket:
            headers = [await _header(socket) for _ in range(5)]
        assert not running.done()
        stop.set()
        await running
        return headers

    headers = asyncio.run(visit())
    made.page.player.stop()
    assert headers[0]["pictures"][0][0] == "frame" and len(headers[0]["pictures"]) == 1
    fault = "pictures cannot be drawn: ZeroDivisionError: no pixels"
    assert fault in headers[0]["status"]["faults"]


def test_a_page_s_port_in_use_is_refused(recording):
    made = served(recording, {"net": HighPass()})
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", made.port))
        taken.listen()
        with pytest.raises(ValueError, match=f"port={made.port} cannot be used"):
            asyncio.run(live.play_and_serve(made))


def test_a_port_in_use_is_refused_before_networks_are_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(live, "build_server", lambda cfg: pytest.fail("networks are loaded"))
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        cfg = config("live", tmp_path / "run", "recording=cap.raw", f"port={port}")
        with pytest.raises(ValueError, match=f"host=127.0.0.1 port={port} cannot be used"):
            live.live(cfg)


def test_port_0_is_a_free_one_that_is_named(recording):
    made = served(recording, {"net": HighPass()})
    made.port, stop = 0, asyncio.Event()
    asyncio.run(made.run(stop.set, stop))
    made.page.player.stop()
    assert made.port > 0


@pytest.mark.parametrize("use", [2, "many", 0])
def test_views_that_are_not_there_are_refused(recording, use):
    made = served(recording, {"net": SetNet.preset("small").eval()})
    with pytest.raises(ValueError, match="views_used must be one of all, 1, 3, 5, 9"):
        made.page.controls.choose("net", use)


def test_one_view_runs_beside_all_of_them(recording):
    made = served(recording, {"net": SetNet.preset("small").eval()}, playback_speed=float("inf"))
    made.page.handle_request({"one_view": True, "tone": "auto"})
    player = made.page.player
    player.start()
    until(lambda: player.one_view is not None and made.page.frames.count > 5)
    assert b'"one-view"' in made.page.message(whole=True)
    status = made.page.status()
    player.stop()
    assert status["one_view"] and status["tone"] == "auto"
    made.page.handle_request({"network": "net", "views": 1})
    assert not made.page.status()["one_view"]
