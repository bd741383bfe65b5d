"""Live streams by a simulated clock: what comes seldom, late, in long packets, at wild times."""

import errno
import socket
import sys
import threading

import numpy as np
import pytest

from src.live_view import event_feeds, status
from src.live_view.feed_reader import FeedReader, PlaybackClock
from src.live_view.frame_buffer import PolarityAccumulator
from src.live_view.live_windows import WindowCutter, WindowQueue
from src.live_view.status import FaultLog, PipelineCounters
from src.recordings.files.event_file import EVENT
from src.recordings.sensor_lookup import build_lookup
from tests.live_view import scenes

POLL_S = 0.004
FIRST_US = 1_000_000  # of the recorded time, which comes at 100 s of the wall
LATE = "events came too late for 0.2 s: started anew"


class Silent(event_feeds.Feed):
    sensor = scenes.SENSOR

    def iter_event_chunks(self, stopped):
        yield from ()


def some(times) -> np.ndarray:
    made = np.zeros(len(times), EVENT)
    made["t"], made["x"], made["y"], made["p"] = times, np.arange(len(times)) % 100, 5, 1
    return made


class Played:
    """What becomes of chunks (wall s, times in us) at 60 fps, by a clock that polls."""

    def __init__(self, chunks, fps: float = 60.0):
        self.faults, self.waiting = FaultLog(), WindowQueue(10**6)
        cutter = WindowCutter(scenes.SENSOR, fps, self.faults)
        counter = PolarityAccumulator(build_lookup(scenes.views()))
        parts = counter, PlaybackClock(), PipelineCounters(), self.faults
        self.reader = FeedReader(Silent(), cutter, self.waiting, *parts)
        never, last = threading.Event(), chunks[0][0]
        for at, times in [*chunks, (chunks[-1][0] + 0.7, None)]:
            for now in np.arange(last + POLL_S, at, POLL_S):
                self.reader._cut_live(None, float(now), never)
            if times is not None:
                self.reader._cut_live((some(times), at), at, never)
            last = at
        self.windows = list(self.waiting.windows)
        self.times = np.concatenate([window.events["t"] for window in self.windows])
        self.scenes = sum(window.starts_scene for window in self.windows)

    def lost_of(self, chunks, from_s: float = 0.0) -> int:
        """Return how many of the events from `from_s` after the first are in no window."""
        start = FIRST_US + from_s * 1e6
        sent = sum(int((np.asarray(times) >= start).sum()) for _, times in chunks)
        return sent - int((self.times >= start).sum())


def at_once(times_us) -> list:
    """Return chunks of events that are sent one by one when they happen."""
    return [(100 + (int(at) - FIRST_US) * 1e-6 + 5e-4, [int(at)]) for at in times_us]


def packets(period_s: float, seconds: float, *, late_s=0.0, start_s=0.0, chunks=1) -> list:
    """Return packets of 5,000 events a second, each sent at its end, `late_s` later, in `chunks`
    one after the other."""
    made = []
    for k in range(round(seconds / period_s)):
        begin = start_s + k * period_s
        times = np.arange(FIRST_US + begin * 1e6, FIRST_US + (begin + period_s) * 1e6, 200)
        for n, part in enumerate(np.array_split(times.astype(int), chunks)):
            made.append((100 + begin + period_s + late_s + 3e-4 * n, part))
    return made


BAR = packets(0.01, 0.5)
SPARSE = {
    "one event each 250 ms": [FIRST_US + 700_000 + 250_000 * k for k in range(12)],
    "5 a second at random": FIRST_US
    + 6e5
    + np.cumsum(np.random.default_rng(5).exponential(2e5, 15).clip(0, 9e5)),
}


@pytest.mark.parametrize("name", SPARSE)
def test_a_quiet_scene_keeps_its_picture_and_its_events(name):
    chunks = BAR + at_once(SPARSE[name])
    played = Played(chunks, 30.0)
    assert played.scenes == 1 and played.lost_of(chunks) == 0
    assert played.faults.current() == []


@pytest.mark.parametrize("count", [1, 10, 15])
def test_small_bursts_are_not_lost(count):
    bursts = [FIRST_US + 600_000 + 100_000 * k for k in range(12)]
    chunks = BAR + [(100 + t * 1e-6 - 1 + 0.002, t + 100 * np.arange(count)) for t in bursts]
    played = Played(chunks)
    assert played.scenes == 1 and played.lost_of(chunks) == 0


@pytest.mark.parametrize("fps", [60.0, 600.0])
@pytest.mark.parametrize("late_s", [0.052, 0.06, 0.065, 0.15])
def test_a_longer_delay_loses_only_what_came_with_it(fps, late_s):
    chunks = packets(0.01, 0.5) + packets(0.01, 2.5, late_s=late_s, start_s=0.5)
    played = Played(chunks, fps)
    assert played.lost_of(chunks) <= 5000 * late_s
    assert played.scenes == 1 and played.lost_of(chunks, 0.5 + late_s) == 0


@pytest.mark.parametrize("late_s", [0.243, 0.248, 0.253, 0.3])
@pytest.mark.parametrize("period_s", [0.01, 0.1, 0.2])
def test_a_delay_that_windows_do_not_wait_for_restarts_time_once(period_s, late_s):
    chunks = packets(0.01, 0.5) + packets(period_s, 3.0, late_s=late_s, start_s=0.5)
    played = Played(chunks)
    assert played.scenes == 2 and LATE in played.faults.current()
    assert played.lost_of(chunks, 1.1) == 0


@pytest.mark.parametrize("chunks_each", [1, 4])
@pytest.mark.parametrize("period_s", [0.06, 0.1, 0.2])
def test_packets_at_5_hz_and_more_lose_nothing(period_s, chunks_each):
    chunks = packets(period_s, 2.0, chunks=chunks_each)
    played = Played(chunks)
    assert played.scenes == 1 and played.lost_of(chunks) == 0
    assert played.faults.current() == []


def test_packets_too_rare_to_wait_for_are_said_so_and_restart_nothing():
    played = Played(packets(0.3, 3.0))
    assert played.scenes == 1
    assert "packets come every 300 ms: send at 5 Hz or more" in played.faults.current()


def test_one_long_pause_of_the_network_is_no_slow_sender():
    chunks = packets(0.01, 0.5) + packets(0.4, 0.4, start_s=0.5) + packets(0.01, 1.0, start_s=0.9)
    played = Played(chunks)
    assert played.scenes == 1 and not any("Hz" in line for line in played.faults.current())


def test_small_packets_at_a_steady_pace_keep_their_latency():
    assert Played(packets(0.01, 1.0)).reader.camera_clock.delay_s < 0.011


def test_packets_swapped_at_the_start_lie_in_windows_of_their_time():
    first, second, *others = packets(0.01, 0.2)
    played = Played([(first[0], second[1]), (second[0], first[1]), *others])
    assert played.lost_of([first, second, *others]) == 0
    assert played.windows[0].start_us == FIRST_US
    for window in played.windows:
        inside = (window.events["t"] >= window.start_us) & (window.events["t"] < window.end_us)
        assert inside.all()


def test_no_jump_of_time_is_said_before_the_first_event():
    wild = np.random.default_rng(0).integers(10**9, 5 * 10**12, 400)
    cutter = WindowCutter(scenes.SENSOR, 60.0, FaultLog())
    cutter.add(some(wild))
    assert not any("-" in line for line in cutter.faults.current())


def test_counts_do_not_depend_on_who_looks(monkeypatch):
    now, faults = [0.0], FaultLog()
    monkeypatch.setattr(status.time, "perf_counter", lambda: now[0])
    faults.report("size", "off the sensor", 3)
    assert faults.current() == ["off the sensor (3 events)"]
    now[0] = 2 * status.SHOWN_S
    assert faults.current() == []
    faults.report("size", "off the sensor", 2)
    faults.report("packet", "bad packets", 1)
    assert faults.current() == ["off the sensor (5 events)", "bad packets (1 packets)"]
    assert faults.counts() == dict.fromkeys(status.COUNTS.values(), 0) | {
        "events_off_sensor": 5,
        "packets_invalid": 1,
    }


@pytest.fixture
def feed_of_32_bits():
    feed = event_feeds.UdpFeed("udp://127.0.0.1:0", (480, 640), "t32_x16_y15_on1", FaultLog())
    yield feed
    feed.close()


def unpacked(feed, *pieces) -> np.ndarray:
    """Return the times of packets of 32 bits."""
    found = []
    for times in pieces:
        packed = np.zeros(len(times), event_feeds.PACKETS["t32_x16_y15_on1"])
        packed["t"] = np.asarray(times, np.int64) % 2**32
        found.append(feed.unpack(packed)["t"])
    return np.concatenate(found)


@pytest.mark.parametrize("wild", [0, 2**31, 2**32 - 1])
def test_one_wild_time_of_32_bits_moves_no_other(feed_of_32_bits, wild):
    times = 3_000_000_000 + 100 * np.arange(100)
    found = unpacked(feed_of_32_bits, times[:50], [wild], times[50:])
    assert np.array_equal(np.delete(found, 50), times)


def test_a_wild_time_before_the_first_turn_is_left_out_and_counted(feed_of_32_bits):
    times = 1_000_000 + 100 * np.arange(100)
    found = unpacked(feed_of_32_bits, [*times[:50], 2**32 - 1, *times[50:]])
    assert np.array_equal(found, times)
    assert feed_of_32_bits.faults.counts()["events_invalid"] == 1


def test_a_sender_of_32_bits_that_starts_again_jumps_back(feed_of_32_bits):
    found = unpacked(feed_of_32_bits, 3_000_000_000 + np.arange(50), np.arange(50))
    assert np.array_equal(found[50:], np.arange(50))


@pytest.mark.parametrize("pieces", [1, 7, 21])
def test_a_turn_of_32_bits_with_events_out_of_order_is_a_turn(feed_of_32_bits, pieces):
    times = 2**32 - 5000 + 100 * np.arange(100)
    times[[48, 52]] = times[[52, 48]]
    found = unpacked(feed_of_32_bits, *np.array_split(times, pieces))
    assert np.array_equal(found, times)


@pytest.mark.skipif(sys.platform != "linux", reason="the system says no lost packets")
def test_packets_lost_in_the_kernel_are_counted():
    feed = event_feeds.UdpFeed("udp://127.0.0.1:0", (480, 640), "t64_x16_y16_on8", FaultLog())
    feed.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    packed = np.zeros(50, event_feeds.PACKETS["t64_x16_y16_on8"])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for _ in range(100):
            sender.sendto(packed.tobytes(), feed.socket.getsockname())
    stopped, events = threading.Event(), 0
    for chunk, _ in feed.iter_event_chunks(stopped):
        events += len(chunk)
        stopped.set()
    feed.close()
    lost = feed.faults.counts()["packets_lost"]
    assert lost > 0 and lost + events // 50 == 100
    assert any("net.core.rmem_max" in line for line in feed.faults.current())


@pytest.mark.parametrize("granted", [212_992, event_feeds.KERNEL_BUFFER_BYTES])
def test_a_small_buffer_of_the_kernel_is_said_at_the_start(monkeypatch, granted):
    monkeypatch.setattr(event_feeds, "_granted_buffer_bytes", lambda udp: granted)
    feed = event_feeds.UdpFeed("udp://127.0.0.1:0", (4, 4), "t64_x16_y16_on8", FaultLog())
    feed.close()
    said = [f"is {granted} bytes" in line and "sysctl" in line for line in feed.messages]
    assert said == [True] * (granted < event_feeds.KERNEL_BUFFER_BYTES)


def test_a_udp_port_in_use_says_what_to_do(monkeypatch):
    def bind(host, port):
        raise OSError(errno.EADDRINUSE, "Address already in use")

    monkeypatch.setattr(event_feeds, "_bind", bind)
    with pytest.raises(ValueError, match="end it or choose another port"):
        event_feeds.UdpFeed("udp://127.0.0.1:7", (4, 4), "t64_x16_y16_on8", FaultLog())
