"""The windows that wait for the network: a bounded queue that drops whole windows, oldest first."""

import threading
from collections import deque
from dataclasses import replace

from src.live_view.cutter import EventWindow


class Backlog:
    """At most `room` windows; one more pushes the oldest out, or waits, where nothing may be lost.

    Raises ValueError for a `room` below 1.
    """

    def __init__(self, room: int, *, lossless: bool = False):
        if room < 1:
            raise ValueError(f"backlog must be >= 1 windows, got {room}")
        self.room, self.lossless = room, lossless
        self.windows: deque[EventWindow] = deque()
        self.changed = threading.Condition()
        self.dropped = 0

    def put(self, window: EventWindow, stopped: threading.Event) -> None:
        """Add a window; a dropped one that began another scene passes that on to the next."""
        with self.changed:
            while self.lossless and len(self.windows) >= self.room and not stopped.is_set():
                self.changed.wait(0.1)
            fresh = False
            while len(self.windows) >= self.room:
                fresh = self.windows.popleft().fresh or fresh
                self.dropped += 1
            self.windows.append(window)
            if fresh:
                self.windows[0] = replace(self.windows[0], fresh=True)
            self.changed.notify_all()

    def get(self, seconds: float) -> EventWindow | None:
        """Return the oldest window; None when none came within `seconds`."""
        with self.changed:
            if not self.windows:
                self.changed.wait(seconds)
            if not self.windows:
                return None
            window = self.windows.popleft()
            self.changed.notify_all()
            return window

    def clear(self) -> None:
        """Forget what waits."""
        with self.changed:
            self.windows.clear()
            self.changed.notify_all()

    def __len__(self) -> int:
        return len(self.windows)
