"""Training by time: a clock that checkpoints hold, and a learning rate that follows it."""

import math
import time
from typing import Any

from lightning import Callback, Trainer

CLOCKS = {"wall": time.perf_counter, "processor": time.thread_time}


class TrainingClock:
    """Adds up `seconds` of training; the time between `lap` and the next `start` is left out.

    `kind`: wall, or processor, the processor time of the training thread: with one thread on a CPU
    neither other work nor a pause of the process counts.  Raises ValueError for another kind.
    """

    def __init__(self, kind: str = "wall"):
        if kind not in CLOCKS:
            raise ValueError(f"train_clock must be one of {', '.join(CLOCKS)}, got {kind}")
        self.now, self.seconds = CLOCKS[kind], 0.0
        self.last = self.now()

    @property
    def hours(self) -> float:
        return self.seconds / 3600

    def start(self) -> None:
        """Count from now on."""
        self.last = self.now()

    def lap(self) -> None:
        """Count the time since the last lap or start."""
        now = self.now()
        self.seconds, self.last = self.seconds + now - self.last, now


class CosineSchedule(Callback):
    """Train for `train_hours` of the module's clock; the learning rate falls by half a cosine of
    that time, from the optimiser's own to 0 (Loshchilov & Hutter 2017).  None: steps decide.

    The time so far is part of checkpoints, of several processes that of the first.  `warmup_steps`:
    first steps of an optimiser, over which the rate rises from zero.  Raises ValueError for values
    out of range and for a warm-up without `train_hours`.
    """

    def __init__(self, train_hours: float | None = None, warmup_steps: int = 0):
        if train_hours is not None and not 0 < train_hours < math.inf:
            raise ValueError(f"train_hours must be > 0 or null, got {train_hours}")
        if type(warmup_steps) is not int or warmup_steps < 0:
            key = "callbacks.schedule.warmup_steps"
            raise ValueError(f"{key} must be a whole number >= 0, got {warmup_steps}")
        if train_hours is None and warmup_steps:
            key = "callbacks.schedule.warmup_steps"
            raise ValueError(f"{key} must be 0 without train_hours, got {warmup_steps}")
        self.train_hours, self.warmup_steps = train_hours, warmup_steps

    def lr_ratio(self, hours: float) -> float:
        """Return the learning rate after `hours` over that of the beginning."""
        assert self.train_hours is not None
        return (1 + math.cos(math.pi * min(hours / self.train_hours, 1.0))) / 2

    def on_fit_start(self, trainer: Trainer, pl_module: Any) -> None:
        if self.train_hours is None:
            return
        clock = pl_module.clock
        if trainer.world_size > 1:  # or the weights of the processes would part
            clock.seconds = trainer.strategy.broadcast(clock.seconds)
        if clock.hours >= self.train_hours:
            trainer.should_stop = True

    def on_train_batch_start(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        if self.train_hours is None:
            return
        ratio = self.lr_ratio(pl_module.clock.hours)
        steps = trainer.global_step - pl_module.optimizer_start
        ratio *= min(1.0, (steps + 1) / (self.warmup_steps + 1))
        groups = trainer.optimizers[0].param_groups
        for group, rate in zip(groups, pl_module.initial_rates, strict=True):
            group["lr"] = rate * ratio

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        self.on_fit_start(trainer, pl_module)
