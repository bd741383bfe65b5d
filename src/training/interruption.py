"""Signals wait for the end of a step, when weights, optimiser and the count of steps agree."""

import signal
import threading
from collections.abc import Callable
from types import FrameType
from typing import Any

from lightning import Callback, Trainer

from src.training.step_guard import NonFiniteError

DEFERRED = (signal.SIGINT, signal.SIGHUP, signal.SIGUSR1)  # Lightning itself defers SIGTERM


class DeferredSignals(Callback):
    """Ctrl-C, SIGHUP and SLURM's SIGUSR1 act before the next step, a second one at once, as
    Lightning has it: stop with a checkpoint, or store one and requeue the job.  An error in the
    middle of a step, such as a worker's death, leaves no checkpoint: the one before stays the
    newest.
    """

    def __init__(self) -> None:
        self.handlers: dict[int, Callable] = {}
        self.pending: list[int] = []
        self.is_in_step = False

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        if threading.current_thread() is not threading.main_thread():
            return  # Python has signals in the main thread only
        for number in DEFERRED:
            handler = signal.getsignal(number)
            if callable(handler):
                self.handlers[number] = handler
                signal.signal(number, self._defer)

    def on_train_batch_start(self, *_: Any) -> None:
        self._deliver()
        self.is_in_step = True

    def on_train_batch_end(self, *_: Any) -> None:
        self.is_in_step = False

    def on_validation_batch_start(self, *_: Any) -> None:
        self._deliver()

    def on_train_end(self, *_: Any) -> None:
        self._restore_handlers()
        self._deliver()

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        """Store nothing of a step half done (NonFiniteError comes before weights move)."""
        self._restore_handlers()
        if self.is_in_step and not isinstance(exception, NonFiniteError):
            for callback in trainer.checkpoint_callbacks:
                callback.save_on_exception = False  # type: ignore[attr-defined]

    def _defer(self, number: int, frame: FrameType | None) -> None:
        if number in self.pending:
            self._act(number, frame)
        self.pending.append(number)

    def _deliver(self) -> None:
        pending, self.pending = self.pending, []
        for number in pending:
            self._act(number, None)

    def _act(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP:  # its handler acts where it is the handler
            signal.signal(number, self.handlers[number])
        self.handlers[number](number, frame)

    def _restore_handlers(self) -> None:
        for number, handler in self.handlers.items():
            if signal.getsignal(number) == self._defer:
                signal.signal(number, handler)
