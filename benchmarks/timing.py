"""What is timed by default, and how: the least of several repeats, the first one not counted."""

import time
from collections.abc import Callable
from pathlib import Path

RECORDING = Path("../shared/data/events/gen3_640x480_evt2.raw")


def least(work: Callable[[], object], clock=time.thread_time, repeats: int = 12) -> float:
    """Return the least seconds of `clock` that `work` took: CPU time of this thread by default."""
    taken = []
    for _ in range(repeats + 1):
        start = clock()
        work()
        taken.append(clock() - start)
    return min(taken[1:])
