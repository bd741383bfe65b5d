"""From a feed to windows that are over: one thread decodes, another cuts.

A file is read a little ahead and played by its own clock.  What comes live is taken as it comes: a
window is over when an event after it has come, or by the clock when nothing does.
"""

import math
import queue
import threading
import time
from dataclasses import replace

import numpy as np

from src.live_view.backlog import Backlog
from src.live_view.cutter import Cutter
from src.live_view.faults import Faults
from src.live_view.feeds import Feed
from src.live_view.meters import Meters
from src.live_view.pace import Pace, StreamClock
from src.live_view.screen import EventPicture

AHEAD = 16  # chunks that wait to be cut
POLL_S = 0.002  # between two looks at the clock while nothing comes
PATIENCE_S = 0.003  # for which events of a window may be on their way when it is over
STALL_S = 1.0  # without events, a live stream is said to have stalled
COVERED = 0.99  # of the last window, or the recording ends before it


class Intake:
    """Fills `backlog` with windows of `feed`, and `marks` with their events, until `stopped`.

    `state`: waiting | playing | stalled | ended | broken.  Raises ValueError for a live feed that
    is to be played at another speed than 1.
    """

    def __init__(
        self,
        feed: Feed,
        cutter: Cutter,
        backlog: Backlog,
        marks: EventPicture,
        pace: Pace,
        meters: Meters,
        faults: Faults,
    ):
        if feed.live and pace.speed != 1:
            raise ValueError(f"speed must be 1 for what comes live, got {pace.speed}")
        self.feed, self.cutter, self.backlog, self.marks = feed, cutter, backlog, marks
        self.pace, self.meters, self.faults = pace, meters, faults
        self.chunks: queue.Queue = queue.Queue(AHEAD)
        self.clock = StreamClock()
        self.arrived: float | None = None  # wall time of the newest live chunk
        self.state = "waiting"

    def asked_fps(self) -> float | None:
        """Return how many frames a second are asked for; None for as many as there can be."""
        asked = self.pace.speed * 1e6 / self.cutter.period
        return round(asked, 1) if math.isfinite(asked) else None

    def decode(self, stopped: threading.Event) -> None:
        """Read the feed to its end."""
        spent = time.thread_time()
        try:
            for chunk in self.feed.chunks(stopped):
                now = time.thread_time()
                self.meters.spent("decode", now - spent)
                self._offer(chunk, stopped)
                spent = time.thread_time()
        except ValueError as error:
            self.faults.tell("file", str(error), stays=True)
        self._offer(None, stopped)

    def _offer(self, chunk, stopped: threading.Event) -> None:
        """Queue a chunk; a file waits for room, a live stream loses its oldest chunk."""
        while not stopped.is_set():
            try:
                return self.chunks.put(chunk, timeout=0.1 if not self.feed.live else 0.0)
            except queue.Full:
                if self.feed.live:
                    lost, _ = self.chunks.get_nowait()
                    self.faults.tell("lost", "events came faster than they are cut", len(lost))

    def cut(self, stopped: threading.Event) -> None:
        """Cut what was decoded, and hand each window on when it is over."""
        turn = self._cut_live if self.feed.live else self._cut_file
        spent = time.thread_time()
        while not stopped.is_set() and self.state not in ("ended", "broken"):
            turn(stopped)
            now = time.thread_time()
            self.meters.spent("cut", now - spent)
            spent = now

    def _cut_file(self, stopped: threading.Event) -> None:
        chunk = self._next(0.1)
        if chunk is None:
            return
        if chunk == "end":
            if self.cutter.origin is not None:  # the last window, if the file covers it
                self._play(self.cutter.last + (1 - COVERED) * self.cutter.period + 1, stopped)
            self.state = "broken" if self.faults.has("file") else "ended"
            return
        self.cutter.add(chunk[0])
        if self.cutter.origin is None:
            return
        if self.pace.anchor is None:
            self.pace.start(self.cutter.origin)
            self.state = "playing"
        self._play(self.cutter.last, stopped)

    def _play(self, until_us: float, stopped: threading.Event) -> None:
        for window in self.cutter.windows(until_us):
            due = self.pace.wait(window.end_us, stopped)
            if due is None:
                return
            self._hand_on(replace(window, due=due), stopped)

    def _cut_live(self, stopped: threading.Event) -> None:
        chunk, now = self._next(POLL_S), time.perf_counter()
        if not self.pace.running.is_set():  # a pause: what comes is not kept
            self._start_anew()
            return
        if chunk is not None and chunk != "end":
            self._arrive(*chunk)
        if self.arrived is None:
            return
        if now - self.arrived > STALL_S:
            self.state = "stalled"
            silent = now - self.arrived
            self.faults.tell("stall", f"no events for {math.floor(silent)} s, waiting")
        elif self.cutter.origin is not None:
            self.state = "playing"
            until = max(self.cutter.last, self.clock.recorded_us(now - PATIENCE_S))
            for window in self.cutter.windows(until):
                due = self.clock.wall(window.end_us)
                self._hand_on(replace(window, due=due), stopped)

    def _arrive(self, events: np.ndarray, wall: float) -> None:
        """Take a live chunk; after a silence or a leap of the camera's clock, time starts anew."""
        if self.arrived is not None:
            stalled = wall - self.arrived > STALL_S
            timed = self.clock.offset is not None
            if stalled or (timed and self.cutter.leaps(events, self.clock.recorded_us(wall))):
                self._start_anew()
        self.faults.clear("stall")
        self.arrived = wall
        if self.cutter.add(events):
            self.clock = StreamClock()
        if self.cutter.origin is not None:
            self.clock.observe(self.cutter.last, wall)

    def _start_anew(self) -> None:
        self.cutter.restart(fresh=False)
        self.clock = StreamClock()

    def _next(self, seconds: float):
        try:
            chunk = self.chunks.get(timeout=seconds)
        except queue.Empty:
            return None
        return "end" if chunk is None else chunk

    def _hand_on(self, window, stopped: threading.Event) -> None:
        self.marks.add(window.events)
        self.backlog.put(window, stopped)
