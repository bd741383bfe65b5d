"""Where the time of a training step goes: simulating the batch, training on it."""

import time

from lightning import Callback


class SpeedSplit(Callback):
    """Print once, after `after` steps, the seconds per step of simulation and of training.

    With workers the two overlap, so the share is that of the work, not of the wall time.
    The first half of the steps warms up and is not counted.
    """

    def __init__(self, after: int = 20):
        self.after, self.seen = after, 0
        self.simulated, self.trained, self.started = 0.0, 0.0, 0.0

    def on_train_batch_start(self, trainer, module, batch, batch_idx: int) -> None:
        """Note the time the training step begins."""
        self.started = time.perf_counter()

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx: int) -> None:
        """Add up; print when enough steps are seen."""
        self.seen += 1
        if self.after // 2 < self.seen <= self.after:
            self.simulated += batch.seconds
            self.trained += time.perf_counter() - self.started
        if self.seen == self.after:
            trainer.print(self.text(self.after - self.after // 2))

    def text(self, steps: int) -> str:
        """Return the line that is printed."""
        share = self.simulated / max(self.simulated + self.trained, 1e-12)
        return (
            f"per step: simulation {self.simulated / steps:.3f} s, "
            f"training {self.trained / steps:.3f} s, simulation is {share:.0%} of the work"
        )
