"""Chunks of events to windows of 1 / fps, what may be wrong with a live stream, and the queue."""

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from src.live_view.status import FaultLog
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.views import Size

MAX_LATE_US = 50_000  # events may arrive out of order by less; more is another recording


@dataclass(frozen=True)
class EventWindow:
    """Events (t x y p) in [start_us, end_us); `due_s`: the wall time at which the window is over.

    `starts_scene`: it continues nothing that came before.
    """

    start_us: float
    end_us: float
    events: np.ndarray
    due_s: float = 0.0
    starts_scene: bool = False


class WindowCutter:
    """Keeps events until a window of 1 / `fps` is whole; reports to `faults` what is wrong.

    Raises ValueError for an `fps` out of range.
    """

    def __init__(self, sensor: Size, fps: float, faults: FaultLog):
        if not 0 < fps <= 1e5:
            raise ValueError(f"fps must be in (0, 1e5], got {fps}")
        self.sensor, self.period_us, self.faults = sensor, 1e6 / fps, faults
        self.pending: list[np.ndarray] = []
        self.origin_us: float | None = None  # start of the first window
        self.windows_cut = 0  # since the origin
        self.last_us = 0.0  # time of the newest event
        self.starts_scene = True

    def restart(self, *, new_scene: bool = True) -> None:
        """Forget the clock: the next event starts a window, of a new scene or not."""
        self.pending, self.origin_us, self.windows_cut = [], None, 0
        self.starts_scene = self.starts_scene or new_scene

    def add(self, events: np.ndarray) -> bool:
        """Take a chunk, less events off the sensor; return whether the clock restarted, as after a
        jump back in time."""
        events, restarted = self._on_sensor(events), False
        if not events.size:
            return False
        first_us = float(events["t"][0])
        if self.origin_us is not None and first_us < self.last_us - MAX_LATE_US:
            back_s = (self.last_us - first_us) * 1e-6
            self.faults.report("time", f"time jumped back by {back_s:.3g} s: started anew")
            self.restart()
        if self.origin_us is None:
            self.origin_us = self.last_us = first_us
            restarted = True
        events = self._in_order(events)
        self.last_us = float(events["t"][-1])
        self.pending.append(events)
        return restarted

    def pop_windows(self, until_us: float) -> Iterator[EventWindow]:
        """Yield the windows that are over at `until_us`, each without its `due_s`."""
        if self.origin_us is None:
            return
        end_us = self.origin_us + (self.windows_cut + 1) * self.period_us
        if end_us > until_us:
            return
        events = concatenate_events(self.pending)
        over = int((until_us - self.origin_us) / self.period_us) - self.windows_cut
        ends = (end_us + self.period_us * np.arange(max(over, 1))).tolist()
        stops = [count_before(events, end) for end in ends]
        self.pending, self.windows_cut = [events[stops[-1] :]], self.windows_cut + len(ends)
        starts_scene, self.starts_scene, start = self.starts_scene, False, 0
        for end, stop in zip(ends, stops, strict=True):
            part = events[start:stop]
            yield EventWindow(end - self.period_us, end, part, starts_scene=starts_scene)
            starts_scene, start = False, stop

    def _on_sensor(self, events: np.ndarray) -> np.ndarray:
        height, width = self.sensor
        if not events.size or (events["x"].max() < width and events["y"].max() < height):
            return events
        inside = (events["x"] < width) & (events["y"] < height)
        reach = f"{int(events['x'].max()) + 1}x{int(events['y'].max()) + 1}"
        text = f"events up to {reach} are off the {width}x{height} sensor"
        self.faults.report("size", text, len(events) - int(inside.sum()))
        return events[inside]

    def _in_order(self, events: np.ndarray) -> np.ndarray:
        """Return events whose time does not decrease: a late one gets the latest time so far."""
        t = events["t"]
        if t[0] >= self.last_us and not (np.diff(t) < 0).any():
            return events
        events = events.copy()
        held = np.maximum.accumulate(np.maximum(t, int(self.last_us)))
        self.faults.report("order", "events came out of order: held", int((held > t).sum()))
        events["t"] = held
        return events


class WindowQueue:
    """At most `capacity` windows; one more drops the oldest or, `lossless`, waits for room.

    `dropped` counts the windows that were.  Raises ValueError for a `capacity` below 1.
    """

    def __init__(self, capacity: int, *, lossless: bool = False):
        if capacity < 1:
            raise ValueError(f"max_waiting_windows must be >= 1, got {capacity}")
        self.capacity, self.lossless = capacity, lossless
        self.windows: deque[EventWindow] = deque()
        self.changed = threading.Condition()
        self.dropped = 0

    def put(self, window: EventWindow, stopped: threading.Event) -> None:
        """Add a window; where one that starts a scene is dropped, the next one starts it."""
        with self.changed:
            while self.lossless and len(self.windows) >= self.capacity and not stopped.is_set():
                self.changed.wait(0.1)
            starts_scene = False
            while len(self.windows) >= self.capacity:
                starts_scene = self.windows.popleft().starts_scene or starts_scene
                self.dropped += 1
            self.windows.append(window)
            if starts_scene:
                self.windows[0] = replace(self.windows[0], starts_scene=True)
            self.changed.notify_all()

    def get(self, timeout_s: float) -> EventWindow | None:
        """Return the oldest window; None when none came within `timeout_s`."""
        with self.changed:
            if not self.windows and not self.changed.wait(timeout_s):
                return None
            window = self.windows.popleft() if self.windows else None
            self.changed.notify_all()
            return window

    def __len__(self) -> int:
        return len(self.windows)
