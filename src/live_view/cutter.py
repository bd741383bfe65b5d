"""Chunks of events to windows of 1 / fps, and what may be wrong with a stream that comes live."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from src.live_view.faults import Faults
from src.recordings.files.event_arrays import joined, until
from src.recordings.views import Size

BACK_US = 50_000  # events may arrive out of order by less; more is another recording
AHEAD_US = 1_000_000  # of a camera's clock ahead of ours is a leap, not a silence


@dataclass(frozen=True)
class EventWindow:
    """Events (t x y p) in [start_us, end_us); `due`: the wall time (s) at which the window is
    over.  `fresh`: it continues nothing that came before.
    """

    start_us: float
    end_us: float
    events: np.ndarray
    due: float = 0.0
    fresh: bool = False


class Cutter:
    """Keeps events until a window of 1 / `fps` is whole; tells `faults` what is wrong with them.

    Raises ValueError for an `fps` out of range.
    """

    def __init__(self, sensor: Size, fps: float, faults: Faults):
        if not 0 < fps <= 1e5:
            raise ValueError(f"fps must be in (0, 1e5], got {fps}")
        self.sensor, self.period, self.faults = sensor, 1e6 / fps, faults
        self.pending: list[np.ndarray] = []
        self.origin: float | None = None  # time of the first window's start, us
        self.cut = 0  # windows since
        self.last = 0.0  # time of the newest event
        self.fresh = True

    def restart(self, *, fresh: bool = True) -> None:
        """Forget the clock: the next event starts a window, `fresh` where it is another scene."""
        self.pending, self.origin, self.cut = [], None, 0
        self.fresh = self.fresh or fresh

    def add(self, events: np.ndarray) -> bool:
        """Take a chunk; return whether the clock started anew, as after a jump back in time.

        Events off the sensor are left out.
        """
        events, anew = self._on_sensor(events), False
        if not events.size:
            return False
        if self.origin is not None and events["t"][0] < self.last - BACK_US:
            back = (self.last - float(events["t"][0])) * 1e-6
            self.faults.tell("time", f"time jumped back by {back:.3g} s: started anew")
            self.restart()
        if self.origin is None:
            self.origin = self.last = float(events["t"][0])
            anew = True
        events = self._in_order(events)
        self.last = float(events["t"][-1])
        self.pending.append(events)
        return anew

    def leaps(self, events: np.ndarray, now_us: float) -> bool:
        """Return whether `events` come from long after `now_us`, the time of the camera's clock."""
        return bool(events.size) and float(events["t"][0]) > now_us + AHEAD_US

    @property
    def end_us(self) -> float:
        """When the window that is filled now will be over."""
        return self.origin + (self.cut + 1) * self.period

    def windows(self, until_us: float) -> Iterator[EventWindow]:
        """Yield the windows that are over at `until_us`, each without its `due`."""
        if self.origin is None or self.end_us > until_us:
            return
        events = joined(self.pending)
        over = int((until_us - self.origin) / self.period) - self.cut
        ends = (self.end_us + self.period * np.arange(max(over, 1))).tolist()
        stops = [until(events, end) for end in ends]
        self.pending, self.cut = [events[stops[-1] :]], self.cut + len(ends)
        first, self.fresh, before = self.fresh, False, 0
        for end, stop in zip(ends, stops, strict=True):
            yield EventWindow(end - self.period, end, events[before:stop], fresh=first)
            first, before = False, stop

    def _on_sensor(self, events: np.ndarray) -> np.ndarray:
        height, width = self.sensor
        if not events.size or (events["x"].max() < width and events["y"].max() < height):
            return events
        inside = (events["x"] < width) & (events["y"] < height)
        reach = f"{int(events['x'].max()) + 1}x{int(events['y'].max()) + 1}"
        lost = len(events) - int(inside.sum())
        self.faults.tell("size", f"events up to {reach} are off the {width}x{height} sensor", lost)
        return events[inside]

    def _in_order(self, events: np.ndarray) -> np.ndarray:
        """Return events whose time does not decrease: a late one has the latest time so far."""
        t = events["t"]
        if t[0] >= self.last and not (np.diff(t) < 0).any():
            return events
        events = events.copy()
        held = np.maximum.accumulate(np.maximum(t, int(self.last)))
        self.faults.tell("order", "events came out of order: held", int((held > t).sum()))
        events["t"] = held
        return events
