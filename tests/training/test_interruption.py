"""Signals wait for the end of a step."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from lightning import Trainer

from src.app.stop_signals import StoppedBySignal, stop_by_signals
from src.training.interruption import DeferredSignals

TRAINER, MODULE = Trainer(logger=False), None


@contextmanager
def stopped_step() -> Iterator[DeferredSignals]:
    """Begin a step, which a signal must stop in the block."""
    callback = DeferredSignals()
    with pytest.raises((KeyboardInterrupt, StoppedBySignal)), stop_by_signals():
        callback.on_train_start(TRAINER, MODULE)
        callback.on_train_batch_start(TRAINER, MODULE, None, 0)
        yield callback
    callback.on_exception(TRAINER, MODULE, KeyboardInterrupt())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_in_a_step_stops_the_training_after_it(number):
    with stopped_step() as callback:
        signal.raise_signal(number)
        callback.on_train_batch_end(TRAINER, MODULE, None, None, 0)
        assert not callback.is_in_step
        callback.on_train_batch_start(TRAINER, MODULE, None, 1)
        pytest.fail("the next step has begun")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_second_signal_in_a_step_acts_at_once(number):
    with stopped_step():
        signal.raise_signal(number)
        signal.raise_signal(number)
        pytest.fail("the step goes on")
