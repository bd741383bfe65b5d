"""Signals that end a command: every open block is left as by an error, so that files are closed."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

TERMINATING = (signal.SIGTERM, signal.SIGHUP)
AGAIN_AFTER_S = 0.05


class StoppedBySignal(SystemExit):
    """A signal of TERMINATING arrived, which `number` is; the exit code is 128 + that."""

    def __init__(self, number: int):
        super().__init__(128 + number)
        self.number = number


@contextmanager
def stop_by_signals() -> Iterator[None]:
    """Raise StoppedBySignal in the block for the signals of TERMINATING that would end the process.

    Where Python drops it or a KeyboardInterrupt, as in callbacks of weak references, it is raised
    again soon after.  A handler that takes a signal over in the block decides: Lightning's waits
    for the end of a step.  Outside of the main thread nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    owner, report_dropped = os.getpid(), sys.unraisablehook

    def stop(number: int, frame: FrameType | None) -> None:
        if os.getpid() != owner:  # a forked worker: what is open is its parent's
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        if signal.getsignal(number) is stop:  # else another handler, Lightning's, calls this one
            raise StoppedBySignal(number)

    def raise_again(dropped: "sys.UnraisableHookArgs") -> None:
        error = dropped.exc_value
        if not isinstance(error, KeyboardInterrupt | StoppedBySignal):
            report_dropped(dropped)
            return
        number = error.number if isinstance(error, StoppedBySignal) else signal.SIGINT
        timer = threading.Timer(AGAIN_AFTER_S, os.kill, (owner, number))
        timer.daemon = True
        timer.start()

    ours = [number for number in TERMINATING if signal.getsignal(number) == signal.SIG_DFL]
    for number in ours:  # SIGHUP is ignored under nohup
        signal.signal(number, stop)
    sys.unraisablehook = raise_again
    try:
        yield
    finally:
        sys.unraisablehook = report_dropped
        for number in ours:
            if signal.getsignal(number) is stop:
                signal.signal(number, signal.SIG_DFL)
