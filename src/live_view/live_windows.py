"""Chunks of events to windows of 1 / fps, what may be wrong with a live stream, and the queue."""

import threading
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from src.live_view.status import FaultLog
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.files.event_file import EVENT
from src.recordings.files.event_order import BUFFER_US, EventSorter
from src.recordings.noise_filter import NoiseFilter
from src.recordings.views import HeightWidth

FEW_LIVE_EVENTS = 16  # with times far from the others; more of them are a clock that restarts
ANY_GAP_US = 2**61
MAX_BLOCK = 1024  # windows that are cut at a time


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

    What `is_live` is put in order by the rule of files (EventSorter), but nothing waits for it: an
    event whose window is over is dropped.  The events of a file are in order.  Windows hold the
    events that `noise_filter` keeps; it moves none.  Raises ValueError for an `fps` out of range.
    """

    def __init__(
        self, sensor: HeightWidth, fps: float, faults: FaultLog, *, is_live: bool = True,
        noise_filter: NoiseFilter | None = None,
    ):  # fmt: skip
        if not 0 < fps <= 1e5:
            raise ValueError(f"fps must be in (0, 1e5], got {fps}")
        self.sensor, self.fps, self.faults = sensor, fps, faults
        self.noise_filter = noise_filter
        self.period_us = 1e6 / fps
        self.buffer_us = BUFFER_US if is_live else ANY_GAP_US
        self.order = EventSorter(self.buffer_us, FEW_LIVE_EVENTS, "newest")
        self.reported = (0, 0)  # of `order`: events that were late, and dropped
        self.origin_us: float | None = None  # start of the first window
        self.windows_cut = 0  # since the origin
        self.starts_scene = True

    @property
    def last_us(self) -> float:
        """Return the time of the newest event that is no outlier."""
        return float(self.order.last_us)

    @property
    def dropped(self) -> int:
        """Return how many events were dropped for their times since the clock began."""
        return self.order.dropped

    def restart(self, *, new_scene: bool = True) -> None:
        """Forget the clock: the next event starts a window, of a new scene or not."""
        self.order = EventSorter(self.buffer_us, FEW_LIVE_EVENTS, "newest")
        self.reported = (0, 0)
        self._forget_windows(new_scene)

    def _forget_windows(self, new_scene: bool) -> None:
        self.origin_us, self.windows_cut = None, 0
        self.starts_scene = self.starts_scene or new_scene
        if self.noise_filter:
            self.noise_filter.reset()

    def add(self, events: np.ndarray) -> bool:
        """Take a chunk, less events off the sensor; return whether the clock restarted, as after a
        jump back in time."""
        events = self.drop_events_off_sensor(events)
        order = self.order
        part = order.parts[-1]
        order.add(events)
        self._report_disorder()
        if order.parts[-1] is not part:
            self.report_jump_back(part.last_us - order.parts[-1].first_us)
            self._forget_windows(True)
        is_new = self.origin_us is None and order.first_held_us is not None
        if not self.windows_cut and order.first_held_us is not None:
            self.origin_us = float(order.first_held_us)
        return is_new

    def report_jump_back(self, back_us: float) -> None:
        """Say that time jumped back, if it did."""
        if back_us > 0:
            self.faults.report("time", f"time jumped back by {back_us * 1e-6:.3g} s: started anew")

    def report_dropped(self, count: int) -> None:
        """Say that so many events were dropped, if any."""
        if count:
            text = "events came too late or far out of order: dropped"
            self.faults.report("late", text, count)

    def _report_disorder(self) -> None:
        """Say how many events were late or dropped since the last call."""
        counts = (self.order.late, self.order.dropped)
        late, dropped = (now - before for now, before in zip(counts, self.reported, strict=True))
        self.reported = counts
        if late:
            self.faults.report("order", "events came out of order: sorted", late)
        self.report_dropped(dropped)

    def pop_windows(self, until_us: float) -> Iterator[EventWindow]:
        """Yield the windows that are over at `until_us`, each without its `due_s`."""
        while self.origin_us is not None and (ends := self._next_ends(until_us)):
            self.order.accept_events_after_gap(until_us)
            self._report_disorder()
            ready = self.order.release(ends[-1])
            events = concatenate_events(ready) if ready else np.empty(0, EVENT)
            events = self.noise_filter(events) if self.noise_filter else events
            start_us, start = self._end_us(self.windows_cut), 0
            self.windows_cut += len(ends)
            for end_us in ends:
                stop = count_before(events, end_us)
                starts_scene, self.starts_scene = self.starts_scene, False
                yield EventWindow(start_us, end_us, events[start:stop], starts_scene=starts_scene)
                start_us, start = end_us, stop

    def _next_ends(self, until_us: float) -> list[float]:
        """Return the ends of the next windows that are over at `until_us`, MAX_BLOCK at most."""
        ends: list[float] = []
        while len(ends) < MAX_BLOCK:
            end_us = self._end_us(self.windows_cut + len(ends) + 1)
            if end_us > until_us:
                break
            ends.append(end_us)
        return ends

    def _end_us(self, windows: int) -> float:
        """Return the end of the last of so many windows, as `src.reconstruct` computes it."""
        assert self.origin_us is not None
        return self.origin_us + windows * 1e6 / self.fps

    def drop_events_off_sensor(self, events: np.ndarray) -> np.ndarray:
        """Return the events on the sensor; reports how many are not."""
        height, width = self.sensor
        if not events.size or (events["x"].max() < width and events["y"].max() < height):
            return events
        inside = (events["x"] < width) & (events["y"] < height)
        reach = f"{int(events['x'].max()) + 1}x{int(events['y'].max()) + 1}"
        text = f"events up to {reach} are off the {width}x{height} sensor"
        self.faults.report("size", text, len(events) - int(inside.sum()))
        return events[inside]


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

    def put_within_capacity(self, window: EventWindow, stopped: threading.Event) -> None:
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
