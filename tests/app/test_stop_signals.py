"""Signals end a command with its blocks closed, one line and 128 + the number."""

import os
import signal
import time
import weakref

import pytest

from src.app.stop_signals import TERMINATING, StoppedBySignal, stop_by_signals
from tests.faults.harness import Run


class Kept:
    """What a weak reference can be to."""


def drop_in_a_callback(number: int) -> None:
    """Send a signal from a callback, of which Python drops what it raises."""
    kept = Kept()
    _reference = weakref.ref(kept, lambda _: signal.raise_signal(number))
    del kept
    time.sleep(20)


@pytest.mark.parametrize("number", [signal.SIGINT, *TERMINATING])
def test_a_signal_in_a_callback_of_python_is_not_lost(number, tmp_path):
    run = Run(tmp_path / "log", drop_in_a_callback, number)
    assert (run.wait(), run.text()) == (128 + number, "stopped\n")


@pytest.fixture(autouse=True)
def default_handlers():
    before = [signal.signal(number, signal.SIG_DFL) for number in TERMINATING]
    yield
    for number, handler in zip(TERMINATING, before, strict=True):
        signal.signal(number, handler)


@pytest.mark.parametrize("number", TERMINATING)
def test_open_blocks_are_left_and_the_handler_goes(number):
    closed = False
    with pytest.raises(StoppedBySignal) as stopped, stop_by_signals():
        try:
            signal.raise_signal(number)
        finally:
            closed = True
    assert closed and stopped.value.code == 128 + number
    assert signal.getsignal(number) == signal.SIG_DFL


def test_a_hangup_that_is_ignored_stays_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    with stop_by_signals():
        signal.raise_signal(signal.SIGHUP)
    assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN


def test_a_handler_that_takes_over_decides():
    seen = []
    with stop_by_signals():
        ours = signal.getsignal(signal.SIGTERM)

        def lightnings(number, frame):
            seen.append(number)
            ours(number, frame)  # as it calls those that it finds

        signal.signal(signal.SIGTERM, lightnings)
        signal.raise_signal(signal.SIGTERM)
        assert seen == [signal.SIGTERM]


def test_a_forked_worker_ends_without_closing_what_is_its_parents(tmp_path):
    with stop_by_signals():
        child = os.fork()
        if child == 0:
            try:
                signal.raise_signal(signal.SIGTERM)
            finally:
                (tmp_path / "closed").touch()
                os._exit(0)
        _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == -signal.SIGTERM
    assert not (tmp_path / "closed").exists()
