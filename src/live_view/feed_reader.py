"""From a feed to windows that are over: one thread decodes, another cuts.

A file is read a little ahead and played by its own clock.  What comes live is taken as it comes: a
window is over when an event after it has come, or by the clock when nothing does.  Wall times are
seconds of `time.perf_counter`, recorded ones microseconds.
"""

import math
import queue
import threading
import time
from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from src.live_view.event_feeds import Feed
from src.live_view.frame_buffer import PolarityAccumulator
from src.live_view.live_windows import (
    FEW_LIVE_EVENTS,
    EventWindow,
    WindowCutter,
    WindowQueue,
)
from src.live_view.status import FaultLog, PipelineCounters
from src.recordings.event_windows import COVERED, describe_short_recording
from src.recordings.files.event_arrays import concatenate_events
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_order import BUFFER_US

NAP_S = 0.02  # how long a wait goes on before it looks whether it is still wanted
MAX_DRIFT = 1e-4  # by which a camera's clock may run slow against ours: 100 ppm
MAX_AHEAD_US = 1_000_000  # of a camera's clock ahead of ours is a jump, not a silence
MAX_CHUNKS = 16  # that wait to be cut
POLL_S = 0.002  # between two looks at the clock while nothing comes
PATIENCE_S = 0.003  # by which events may come later than those before them
LEAST_PACKETS_HZ = 5  # of a live stream of which no event is to be lost
MAX_DELAY_S = 1.25 / LEAST_PACKETS_HZ  # of events that come in packets, for which windows wait
DELAY_KEPT_S = 5.0  # after which a delay that does not recur is forgotten
BEHIND_S = 0.2  # for which a stream that is late loses events, before time restarts
BEHIND_SHARE = 0.1  # of its events that are lost in that time, at least
LEAST_LATE_S = MAX_DELAY_S / 4  # by which all of them are late: where restarting helps
AGAIN = "again"  # in place of a chunk: the recording starts again
STALL_S = 1.0  # without events, a live stream is said to have stalled


class PlaybackClock:
    """Plays a recording: `speed` recorded seconds in a second of the wall, inf: nothing waits.

    `running` is cleared for a pause.  Raises ValueError for a `speed` that is not above 0.
    """

    def __init__(self, speed: float = 1.0):
        if not speed > 0:
            raise ValueError(f"playback_speed must be > 0 (.inf: as fast as it goes), got {speed}")
        self.speed = speed
        self.anchor: tuple[float, float] | None = None  # recorded us, wall s
        self.running = threading.Event()
        self.running.set()

    def start(self, recorded_us: float) -> None:
        """Make `recorded_us` due now."""
        self.anchor = (recorded_us, time.perf_counter())

    def wait_until_due(self, recorded_us: float, stopped: threading.Event) -> float | None:
        """Sleep until `recorded_us` is due, through pauses, and return when that was; None when
        `stopped` is set before."""
        while not stopped.is_set():
            if not self.running.is_set():
                self._sleep_through_pause(stopped)
                continue
            due_s = time.perf_counter()
            if self.anchor is not None and not math.isinf(self.speed):
                at_us, wall_s = self.anchor
                due_s = wall_s + (recorded_us - at_us) * 1e-6 / self.speed
            left_s = due_s - time.perf_counter()
            if left_s <= 0:
                return due_s
            time.sleep(min(left_s, NAP_S))
        return None

    def _sleep_through_pause(self, stopped: threading.Event) -> None:
        """Wait for the end of a pause; what comes after it is later by its length."""
        start_s = time.perf_counter()
        while not (self.running.wait(NAP_S) or stopped.is_set()):
            pass
        if self.anchor is not None:
            at_us, wall_s = self.anchor
            self.anchor = (at_us, wall_s + time.perf_counter() - start_s)


class CameraClock:
    """The wall time of a camera's clock, after the events that came soonest.

    What travels and is buffered comes late by changing spans; the least of them is taken for none.
    """

    def __init__(self):
        self.offset_s = math.nan  # wall minus recorded
        self.observed_s = 0.0
        self.first_offsets: deque[tuple[float, float]] = deque()  # wall s, falling offset in s

    def observe(self, recorded_us: float, wall_s: float, first_us: float | None = None) -> None:
        """Events up to `recorded_us`, from `first_us` on, came at `wall_s`."""
        offset_s = wall_s - recorded_us * 1e-6
        if not math.isnan(self.offset_s):
            offset_s = min(offset_s, self.offset_s + MAX_DRIFT * (wall_s - self.observed_s))
        self.offset_s, self.observed_s = offset_s, wall_s
        if first_us is not None:
            self._keep_largest(wall_s, wall_s - first_us * 1e-6)

    def _keep_largest(self, wall_s: float, offset_s: float) -> None:
        """Take the offset of the first event of a chunk; forget what is smaller or too long ago."""
        offsets = self.first_offsets
        while offsets and offsets[-1][1] <= offset_s:
            offsets.pop()
        offsets.append((wall_s, offset_s))
        while offsets[0][0] < wall_s - DELAY_KEPT_S:
            offsets.popleft()

    @property
    def delay_s(self) -> float:
        """Return by how much later, in the last DELAY_KEPT_S, the first events of a chunk came, in
        0..MAX_DELAY_S."""
        if not self.first_offsets:
            return 0.0
        return min(max(self.first_offsets[0][1] - self.offset_s, 0.0), MAX_DELAY_S)

    def late_s(self, recorded_us: float, wall_s: float) -> float:
        """Return how late an event of `recorded_us` came at `wall_s`; nan before the first."""
        return wall_s - self.wall_s(recorded_us)

    def wall_s(self, recorded_us: float) -> float:
        """Return the wall time of `recorded_us`; nan before the first event."""
        return recorded_us * 1e-6 + self.offset_s

    def recorded_us(self, wall_s: float) -> float:
        """Return the time of the camera's clock at `wall_s`; nan before the first event."""
        return (wall_s - self.offset_s) * 1e6


class OffClockEvents:
    """The newest events that are off the camera's clock, all of one other clock."""

    def __init__(self):
        self.events = np.empty(0, EVENT)
        self.ahead_us = np.empty(0)  # of our clock

    def add(self, events: np.ndarray, arrival_s: float) -> int:
        """Add events; return how many are let go, as later ones are of another clock."""
        events = concatenate_events([self.events, events])
        ahead_us = events["t"][len(self.ahead_us) :] - arrival_s * 1e6
        ahead_us = np.concatenate([self.ahead_us, ahead_us])
        others = np.flatnonzero(np.abs(ahead_us - ahead_us[-1]) > MAX_AHEAD_US)
        start = int(others[-1]) + 1 if others.size else 0
        self.events, self.ahead_us = events[start:], ahead_us[start:]
        return start


@dataclass
class RecentLoss:
    """Live events since `start_s`: how many, how many of them were lost, and by how much all were
    late."""

    start_s: float
    dropped_before: int  # since the cutter's clock began
    events: int = 0
    least_late_s: float = math.inf

    def is_behind(self, dropped: int) -> bool:
        """Return whether the stream is late as a whole and loses events."""
        lost = dropped - self.dropped_before
        return self.least_late_s > LEAST_LATE_S and lost > BEHIND_SHARE * self.events


class FeedReader:
    """Fills `waiting` with windows of `feed`, and `counter` with their events, until stopped.

    `state`: waiting | playing | stalled | ended | broken.  Raises ValueError for a live feed at
    another playback speed than 1.
    """

    def __init__(
        self,
        feed: Feed,
        cutter: WindowCutter,
        waiting: WindowQueue,
        counter: PolarityAccumulator,
        clock: PlaybackClock,
        meters: PipelineCounters,
        faults: FaultLog,
    ):
        if feed.is_live and clock.speed != 1:
            raise ValueError(f"playback_speed must be 1 for what comes live, got {clock.speed}")
        self.feed, self.cutter, self.waiting, self.counter = feed, cutter, waiting, counter
        self.clock, self.meters, self.faults = clock, meters, faults
        self.chunks: queue.Queue = queue.Queue(MAX_CHUNKS)
        self.camera_clock = CameraClock()
        self.arrival_s: float | None = None  # wall time of the newest live events on the clock
        self.loss: RecentLoss | None = None
        self.rare_s = -math.inf  # wall time of the last packet that began too long before it came
        self.off_clock = OffClockEvents()
        self.scene_events = 0  # on the clock, since the scene began
        self.state = "waiting"

    def decode(self, stopped: threading.Event) -> None:
        """Read the feed to its end."""
        start, end = time.thread_time(), "ended"
        try:
            for events, arrival_s in self.feed.iter_event_chunks(stopped):
                if not events.size:
                    self._offer(AGAIN, stopped)
                    continue
                self.meters.add_busy_time("decode", time.thread_time() - start)
                self._offer((events, arrival_s), stopped)
                start = time.thread_time()
        except ValueError as error:
            self.faults.report("file", str(error), until_cleared=True)
            end = "broken"
        self._offer(end, stopped)

    def _offer(self, chunk: tuple[np.ndarray, float] | str, stopped: threading.Event) -> None:
        """Queue a chunk or the last state; a live stream loses its oldest chunk, a file waits."""
        while not stopped.is_set():
            try:
                return self.chunks.put(chunk, timeout=0.0 if self.feed.is_live else 0.1)
            except queue.Full:
                if self.feed.is_live:
                    lost, _ = self.chunks.get_nowait()
                    self.faults.report("lost", "events came faster than they are cut", len(lost))

    def cut(self, stopped: threading.Event) -> None:
        """Cut what was decoded, and hand each window on when it is over."""
        start = time.thread_time()
        while not stopped.is_set() and self.state not in ("ended", "broken"):
            now_s = time.perf_counter()
            try:
                chunk = self.chunks.get(timeout=POLL_S if self.feed.is_live else 0.1)
            except queue.Empty:
                chunk = None
            if self.feed.is_live:
                self._cut_live(chunk, now_s, stopped)
            elif chunk is not None:
                self._cut_file(chunk, stopped)
            now = time.thread_time()
            self.meters.add_busy_time("cut", now - start)
            start = now

    def _cut_file(self, chunk: tuple[np.ndarray, float] | str, stopped: threading.Event) -> None:
        until_us = self.cutter.last_us + (1 - COVERED) * self.cutter.period_us + 1
        if not isinstance(chunk, str):
            self.cutter.add(chunk[0])
            until_us = self.cutter.last_us
            if self.clock.anchor is None and self.cutter.origin_us is not None:
                self.clock.start(self.cutter.origin_us)
                self.state = "playing"
        for window in self.cutter.pop_windows(until_us):
            due_s = self.clock.wait_until_due(window.end_us, stopped)
            if due_s is None:
                break
            self._hand_on(window, due_s, stopped)
        if chunk in (AGAIN, "ended"):
            self._report_short_recording()
        if chunk == AGAIN:  # nothing of the end is left when the recording starts again
            self.cutter.restart()
            self.clock.anchor = None
        elif isinstance(chunk, str):
            self.state = chunk

    def _report_short_recording(self) -> None:
        """Say that the recording, which is over, was no window long, if so."""
        start_us = self.cutter.origin_us
        if start_us is not None and not self.cutter.windows_cut:
            length_s = (self.cutter.last_us - start_us) * 1e-6
            line = describe_short_recording(self.cutter.fps, length_s)
            self.faults.report("file", line, until_cleared=True)

    def _cut_live(
        self, chunk: tuple[np.ndarray, float] | str | None, now_s: float, stopped: threading.Event
    ) -> None:
        """Take a live chunk, or None where all that came before `now_s` is taken; hand on what is
        over."""
        if not self.clock.running.is_set():  # a pause: what comes is not kept
            self._restart()
            return
        if chunk is not None and not isinstance(chunk, str):
            self._add_live(*chunk)
            now_s = chunk[1]  # what came later may wait behind it
        if self.arrival_s is None:
            return
        if now_s - self.arrival_s > STALL_S:
            self.state = "stalled"
            silent = math.floor(now_s - self.arrival_s)
            self.faults.report("stall", f"no events for {silent} s, waiting")
        elif self.cutter.origin_us is not None:
            self.state = "playing"
            over_s = now_s - self.camera_clock.delay_s - PATIENCE_S
            until_us = max(self.cutter.last_us, self.camera_clock.recorded_us(over_s))
            for window in self.cutter.pop_windows(until_us):
                self._hand_on(window, self.camera_clock.wall_s(window.end_us), stopped)

    def _add_live(self, events: np.ndarray, arrival_s: float) -> None:
        """Take a live chunk; after a silence, a jump of the camera's clock, or where the stream
        stays late and loses events, time restarts."""
        events = self.cutter.drop_events_off_sensor(events)
        silent_s = 0.0 if self.arrival_s is None else arrival_s - self.arrival_s
        if events.size and self.arrival_s is not None:
            events = self._take_on_clock(events, arrival_s, silent_s)
        if not events.size:
            return
        self.faults.clear("stall")
        self.arrival_s = arrival_s
        if self._is_long_behind(events["t"], arrival_s):
            text = f"events came too late for {BEHIND_S:g} s: started anew"
            self.faults.report("time", text)
            self._restart(new_scene=True)
        self.scene_events += len(events)
        before_us = self.cutter.last_us
        if self.cutter.add(events):
            self.camera_clock, before_us = CameraClock(), -math.inf
        first_us = self._find_first_us(events["t"], before_us, arrival_s)
        if silent_s > MAX_DELAY_S < self.camera_clock.late_s(first_us, arrival_s):
            self._report_rare_packets(silent_s, arrival_s)
        if self.cutter.origin_us is not None:
            self.camera_clock.observe(self.cutter.last_us, arrival_s, first_us)

    def _find_first_us(self, times_us: np.ndarray, before_us: float, arrival_s: float) -> float:
        """Return the earliest time, of those up to `before_us`, which are out of order, none more
        than BUFFER_US before `arrival_s`."""
        least_us = self.camera_clock.recorded_us(arrival_s) - BUFFER_US
        late = np.maximum(times_us, least_us)
        return float(np.where(times_us > before_us, times_us, late).min())

    def _report_rare_packets(self, silent_s: float, arrival_s: float) -> None:
        """Say that packets come too seldom, where the last one that did came just before."""
        if arrival_s - self.rare_s <= STALL_S:
            advice = f"send at {LEAST_PACKETS_HZ} Hz or more"
            self.faults.report("rare", f"packets come every {silent_s * 1e3:.0f} ms: {advice}")
        self.rare_s = arrival_s

    def _take_on_clock(self, events: np.ndarray, arrival_s: float, silent_s: float) -> np.ndarray:
        """Return the events on the camera's clock, which goes on after a silence.

        Off it are those far ahead and, after a silence, those earlier than what came before it.
        FEW_LIVE_EVENTS of them, one after the other and of one clock, are a jump, so are as many as
        the scene had before: time restarts, and they are returned.  Fewer are dropped when others
        come.
        """
        is_after_silence = silent_s > STALL_S
        is_off = events["t"] > self.camera_clock.recorded_us(arrival_s) + MAX_AHEAD_US
        if is_after_silence:
            is_off |= events["t"] < self.cutter.last_us - BUFFER_US
        on = np.flatnonzero(~is_off)
        tail = int(on[-1]) + 1 if on.size else 0  # from there on all are off it
        if on.size:
            self.cutter.report_dropped(len(self.off_clock.events) + tail - on.size)
            self.off_clock = OffClockEvents()
        if tail < len(events):
            self.cutter.report_dropped(self.off_clock.add(events[tail:], arrival_s))
            if len(self.off_clock.events) >= min(FEW_LIVE_EVENTS, self.scene_events):
                return self._jump()
        if on.size and is_after_silence:
            self._restart()
        return events if on.size == len(events) else events[on]

    def _jump(self) -> np.ndarray:
        """Restart with the events off the clock, returned; back in time they begin a scene."""
        events, self.off_clock = self.off_clock.events, OffClockEvents()
        back_us = self.cutter.last_us - float(events["t"][0])
        if is_back := back_us > BUFFER_US:
            self.cutter.report_jump_back(back_us)
        self._restart(new_scene=is_back)
        return events

    def _is_long_behind(self, times_us: np.ndarray, arrival_s: float) -> bool:
        """Return whether BEHIND_S are over, in which the stream was late and lost events; events
        of `times_us` come now."""
        is_behind, dropped = False, self.cutter.dropped
        if self.loss is None or arrival_s - self.loss.start_s > BEHIND_S:
            is_at_limit = self.camera_clock.delay_s >= MAX_DELAY_S  # below, windows wait longer
            is_behind = is_at_limit and self.loss is not None and self.loss.is_behind(dropped)
            self.loss = RecentLoss(arrival_s, dropped)
        late_s = self.camera_clock.late_s(float(times_us.max()), arrival_s)
        self.loss.events += len(times_us)
        self.loss.least_late_s = min(self.loss.least_late_s, late_s)
        return is_behind

    def _restart(self, *, new_scene: bool = False) -> None:
        self.cutter.restart(new_scene=new_scene)
        self.scene_events = 0 if new_scene else self.scene_events
        self.camera_clock, self.loss = CameraClock(), None

    def _hand_on(self, window: EventWindow, due_s: float, stopped: threading.Event) -> None:
        self.counter.add(window.events)
        self.waiting.put_within_capacity(replace(window, due_s=due_s), stopped)
