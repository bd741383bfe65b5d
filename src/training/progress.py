"""What is shown while a network trains or is tested: steps or hours of those asked for."""

import time
from typing import Any

from lightning import Trainer
from lightning.pytorch.callbacks import ProgressBar
from rich.progress import BarColumn, Progress, TaskID, TimeElapsedColumn, TimeRemainingColumn

LINE_EVERY_S = 60.0  # where a file is written to instead of a terminal


class TrainingProgress(ProgressBar):
    """The steps of a training, or its `train_hours`, and the loss; `tested` names what is tested.

    On a terminal a bar, elsewhere a line a minute and at the end.
    """

    def __init__(self, train_hours: float | None = None, tested: str = "the network") -> None:
        super().__init__()
        self.train_hours, self.tested = train_hours, tested
        self.bar: Progress | None = None
        self.is_enabled, self.task, self.line_s = True, TaskID(0), 0.0
        self.clips = self.total = 0

    def disable(self) -> None:
        """Show nothing: Lightning calls it in all processes but the first."""
        self.is_enabled = False

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        total = self.train_hours or (trainer.max_steps if trainer.max_steps > 0 else None)
        self._open("training", total)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, outputs: Any, *_: Any) -> None:
        loss = trainer.progress_bar_metrics.get("train/loss")
        said = "" if loss is None else f"loss {loss:.3f}"
        step = trainer.global_step
        if self.train_hours:
            hours = pl_module.clock.hours
            self._show(hours, f"{hours:.2f} of {self.train_hours:g} h, step {step} {said}")
        else:
            of_all = f" of {trainer.max_steps}" if trainer.max_steps > 0 else ""
            self._show(step, f"step {step}{of_all} {said}")

    def on_validation_start(self, trainer: Trainer, pl_module: Any) -> None:
        if self.bar:
            self.bar.update(self.task, description="validation")

    def on_validation_end(self, trainer: Trainer, pl_module: Any) -> None:
        if self.bar:
            self.bar.update(self.task, description="training")

    def on_test_start(self, trainer: Trainer, pl_module: Any) -> None:
        self.clips, self.total = 0, sum(map(int, trainer.num_test_batches))
        self._open(f"testing {self.tested}", self.total)

    def on_test_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        self.clips += 1
        self._show(self.clips, f"{self.clips} of {self.total}")

    def _open(self, name: str, total: float | None) -> None:
        if not self.is_enabled:
            return
        times = TimeElapsedColumn(), "left", TimeRemainingColumn()
        self.bar = Progress("{task.description}", BarColumn(20), "{task.fields[said]}", *times)
        self.task, self.line_s = self.bar.add_task(name, total=total, said=""), time.monotonic()
        if self.bar.console.is_terminal:
            self.bar.start()

    def _show(self, done: float, said: str) -> None:
        if self.bar is None:
            return
        self.bar.update(self.task, completed=done, said=said)
        now, total = time.monotonic(), self.bar.tasks[0].total
        is_last = total is not None and done >= total  # `_close` prints it
        if not (self.bar.console.is_terminal or is_last) and now - self.line_s > LINE_EVERY_S:
            self.line_s = now
            print(f"{self.bar.tasks[0].description}: {said}", flush=True)

    def _close(self, *_: Any) -> None:
        if self.bar is not None:
            task = self.bar.tasks[0]
            if self.bar.console.is_terminal:
                self.bar.stop()
            else:
                print(f"{task.description}: {task.fields['said']}", flush=True)
            self.bar = None

    on_train_end = on_test_end = on_exception = _close  # type: ignore[assignment]
