"""Signals wait for the end of a step, when weights, optimiser and the count of steps agree."""

import signal
import threading

from lightning import Callback, Trainer

from src.training.guard import NotFinite

HELD = (signal.SIGINT, signal.SIGUSR1)  # Lightning itself holds SIGTERM back


class BetweenSteps(Callback):
    """Ctrl-C and SLURM's SIGUSR1 act before the next step; a second one acts at once.

    What they do stays Lightning's: stop with a checkpoint, or store one and requeue the job.  In
    the middle of a step that checkpoint would hold weights of which some have moved already; an
    error that comes there, such as a worker's death, leaves none: the one before stays the newest.
    """

    def __init__(self):
        self.handlers, self.pending, self.inside = {}, [], False

    def on_train_start(self, trainer: Trainer, module) -> None:
        """Put ourselves before the handlers there are."""
        if threading.current_thread() is not threading.main_thread():
            return  # Python has signals in the main thread only
        for number in HELD:
            handler = signal.getsignal(number)
            if callable(handler):
                self.handlers[number] = handler
                signal.signal(number, self._hold)

    def on_train_batch_start(self, trainer: Trainer, module, batch, batch_idx: int) -> None:
        """Let the handlers have what came."""
        self._let_go()
        self.inside = True

    def on_train_batch_end(self, trainer: Trainer, module, outputs, batch, batch_idx: int) -> None:
        """The weights have moved, and the count of steps with them."""
        self.inside = False

    def on_validation_batch_start(self, trainer: Trainer, module, *args) -> None:
        """Let the handlers have what came; a validation moves no weights."""
        self._let_go()

    def on_train_end(self, trainer: Trainer, module) -> None:
        """Leave; what came during the last step acts now."""
        self._leave()
        self._let_go()

    def on_exception(self, trainer: Trainer, module, exception: BaseException) -> None:
        """Leave; nothing is stored of a step half done (NotFinite comes before weights move)."""
        self._leave()
        if self.inside and not isinstance(exception, NotFinite):
            for callback in trainer.checkpoint_callbacks:
                callback.save_on_exception = False

    def _hold(self, number: int, frame) -> None:
        if number in self.pending:
            self.handlers[number](number, frame)
        self.pending.append(number)

    def _let_go(self) -> None:
        pending, self.pending = self.pending, []
        for number in pending:
            self.handlers[number](number, None)

    def _leave(self) -> None:
        for number, handler in self.handlers.items():
            if signal.getsignal(number) == self._hold:
                signal.signal(number, handler)
