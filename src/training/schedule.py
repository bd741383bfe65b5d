"""A training by time: how long it lasts and how its rate falls follow from the hours it has had."""

import math

from lightning import Callback, LightningModule, Trainer


class Hours(Callback):
    """Train for `hours` of the module's clock; the rate falls by half a cosine of that time, from
    the optimiser's own to `floor` of it (Loshchilov & Hutter 2017).  None: steps decide.

    Only the time counts, which checkpoints hold: a training that is cut goes on where it was, and
    one that goes on with more hours goes on along the longer cosine.  `rise`: first
    steps of an optimiser, over which the rate rises from zero: Adam knows no second moments yet.
    """

    def __init__(self, hours: float | None = None, floor: float = 0.0, rise: int = 0):
        if hours is not None and not 0 < hours < math.inf:
            raise ValueError(f"hours must be > 0 or null, got {hours}")
        if not 0 <= floor <= 1:
            raise ValueError(f"callbacks.hours.floor must be in [0, 1], got {floor}")
        if type(rise) is not int or rise < 0:
            raise ValueError(f"callbacks.hours.rise must be a whole number >= 0, got {rise}")
        self.hours, self.floor, self.rise = hours, floor, rise

    def share(self, hours: float) -> float:
        """Return the rate after `hours` over that of the beginning."""
        way = min(hours / self.hours, 1.0)
        return self.floor + (1 - self.floor) * (1 + math.cos(math.pi * way)) / 2

    def on_fit_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Do nothing more when the time is over already."""
        self._stop(trainer, module)

    def on_train_batch_start(
        self, trainer: Trainer, module: LightningModule, batch, batch_idx: int
    ) -> None:
        """Set the rate of the step."""
        if self.hours is None:
            return
        share = self.share(module.clock.hours)
        share *= min(1.0, (trainer.global_step + 1) / (self.rise + 1))
        for group, rate in zip(trainer.optimizers[0].param_groups, module.rates, strict=True):
            group["lr"] = rate * share

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs, batch, batch_idx: int
    ) -> None:
        """Stop when the time is over."""
        self._stop(trainer, module)

    def _stop(self, trainer: Trainer, module: LightningModule) -> None:
        if self.hours is not None and module.clock.hours >= self.hours:
            trainer.should_stop = True
