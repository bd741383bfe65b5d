"""When an instant of a recording, or of a camera's clock, is due on the wall clock.

Wall times are seconds of `time.perf_counter`, recorded ones microseconds.
"""

import math
import threading
import time

NAP_S = 0.02  # how long a wait goes on before it looks whether it is still wanted
DRIFT = 1e-4  # by which a camera's clock may run slow against ours: 100 ppm


class Pace:
    """Plays a recording: `speed` recorded seconds in a second of the wall, inf: nothing waits.

    Raises ValueError for a `speed` that is not above 0.
    """

    def __init__(self, speed: float = 1.0):
        if not speed > 0:
            raise ValueError(f"speed must be > 0 (.inf: as fast as it goes), got {speed}")
        self.speed = speed
        self.anchor: tuple[float, float] | None = None  # recorded us, wall s
        self.running = threading.Event()
        self.running.set()

    def start(self, recorded_us: float) -> None:
        """Make `recorded_us` due now."""
        self.anchor = (recorded_us, time.perf_counter())

    def due(self, recorded_us: float) -> float:
        """Return the wall time at which `recorded_us` is due; now where nothing waits."""
        if math.isinf(self.speed):
            return time.perf_counter()
        at, wall = self.anchor
        return wall + (recorded_us - at) * 1e-6 / self.speed

    def wait(self, recorded_us: float, stopped: threading.Event) -> float | None:
        """Sleep until `recorded_us` is due, through pauses, and return when that was.

        Returns None when `stopped` is set before.
        """
        while not stopped.is_set():
            if not self.running.is_set():
                self._sleep_through(stopped)
                continue
            due = self.due(recorded_us)
            left = due - time.perf_counter()
            if left <= 0:
                return due
            time.sleep(min(left, NAP_S))
        return None

    def _sleep_through(self, stopped: threading.Event) -> None:
        """Wait for the end of a pause; what comes after it is later by its length."""
        began = time.perf_counter()
        while not (self.running.wait(NAP_S) or stopped.is_set()):
            pass
        at, wall = self.anchor
        self.anchor = (at, wall + time.perf_counter() - began)


class StreamClock:
    """The wall time of a camera's clock, after the events that came soonest.

    What travels and is buffered comes late by changing spans; the least of them is taken for none.
    """

    def __init__(self):
        self.offset: float | None = None  # wall s minus recorded s
        self.seen = 0.0

    def observe(self, recorded_us: float, wall: float) -> None:
        """An event of `recorded_us` came at `wall`."""
        offset = wall - recorded_us * 1e-6
        if self.offset is None:
            self.offset = offset
        else:
            self.offset = min(offset, self.offset + DRIFT * (wall - self.seen))
        self.seen = wall

    def wall(self, recorded_us: float) -> float:
        """Return the wall time of `recorded_us`."""
        return recorded_us * 1e-6 + self.offset

    def recorded_us(self, wall: float) -> float:
        """Return the time of the camera's clock at `wall`."""
        return (wall - self.offset) * 1e6
