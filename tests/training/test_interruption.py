"""Signals wait for the end of a step."""

import signal

import pytest
from lightning import Trainer

from src.app.stop_signals import StoppedBySignal, stop_by_signals
from src.training.interruption import DeferredSignals


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_signal_in_a_step_stops_the_training_after_it(number):
    trainer, module, callback = Trainer(logger=False), None, DeferredSignals()
    with pytest.raises((KeyboardInterrupt, StoppedBySignal)), stop_by_signals():
        callback.on_train_start(trainer, module)
        callback.on_train_batch_start(trainer, module, None, 0)
        signal.raise_signal(number)
        callback.on_train_batch_end(trainer, module, None, None, 0)
        assert not callback.is_in_step
        callback.on_train_batch_start(trainer, module, None, 1)
        pytest.fail("the next step has begun")
    callback.on_exception(trainer, module, KeyboardInterrupt())
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_second_signal_in_a_step_acts_at_once(number):
    trainer, module, callback = Trainer(logger=False), None, DeferredSignals()
    with pytest.raises((KeyboardInterrupt, StoppedBySignal)), stop_by_signals():
        callback.on_train_start(trainer, module)
        callback.on_train_batch_start(trainer, module, None, 0)
        signal.raise_signal(number)
        signal.raise_signal(number)
        pytest.fail("the step goes on")
    callback.on_exception(trainer, module, KeyboardInterrupt())
