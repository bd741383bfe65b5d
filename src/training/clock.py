"""How long a training has trained: what a schedule by time and a learning curve count in."""

import time

KINDS = {"wall": time.perf_counter, "processor": time.thread_time}


class Clock:
    """Adds up `seconds` of training; what comes between `lap` and the next `start` is left out.

    `kind`: wall, or processor, the processor time of the thread that trains: with one thread on a
    CPU neither work beside it nor a pause of the process uses up its hours.  Raises ValueError for
    another.
    """

    def __init__(self, kind: str = "wall"):
        if kind not in KINDS:
            raise ValueError(f"clock must be one of {', '.join(KINDS)}, got {kind}")
        self.now, self.seconds = KINDS[kind], 0.0
        self.mark = self.now()

    @property
    def hours(self) -> float:
        """The time so far, in hours."""
        return self.seconds / 3600

    def start(self) -> None:
        """Count from now on."""
        self.mark = self.now()

    def lap(self) -> None:
        """Count what has passed since the last lap or start."""
        now = self.now()
        self.seconds, self.mark = self.seconds + now - self.mark, now
