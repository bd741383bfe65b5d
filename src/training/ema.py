"""The exponential moving average of the weights, which a training validates, tests and exports."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import WeightAveraging
from torch import Tensor


class WeightEMA(WeightAveraging):
    """Lightning's weight averaging with a moving average; buffers are copied.

    `decay`, in [0, 1): 0.999 remembers a thousand steps; the first steps count more, 9 / (10 +
    step).  Checkpoints hold the average as `state_dict` and the weights in training as
    `current_model_state`, also those written during a validation, when the module has the average.
    Raises ValueError for another decay.
    """

    def __init__(self, decay: float):
        if not 0 <= decay < 1:
            raise ValueError(f"ema_decay must be in [0, 1) or null, got {decay}")

        def update(average: Sequence[Tensor], weights: Sequence[Tensor], count: Tensor) -> None:
            rate = max(1 - decay, 9 / (11 + int(count)))
            torch._foreach_lerp_(list(average), list(weights), rate)

        super().__init__(use_buffers=False, multi_avg_fn=update)
        self.is_swapped = False  # the module has the average, and this the weights in training

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self._device = trainer.strategy.root_device  # where the module is moved later
        super().setup(trainer, pl_module, stage)

    def on_save_checkpoint(
        self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]
    ) -> None:
        super().on_save_checkpoint(trainer, pl_module, checkpoint)
        if self.is_swapped:
            weights, average = checkpoint["state_dict"], checkpoint["current_model_state"]
            checkpoint["state_dict"], checkpoint["current_model_state"] = average, weights

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Keep the weights in training, for checkpoints that are written after this."""

    def _swap_models(self, pl_module: LightningModule) -> None:
        super()._swap_models(pl_module)
        self.is_swapped = not self.is_swapped


@contextmanager
def use_averaged_weights(module: LightningModule) -> Iterator[None]:
    """Give `module` the averaged weights within the context, where its trainer has a WeightEMA."""
    averages = [ema for ema in _find_averages(module.trainer) if not ema.is_swapped]
    for ema in averages:
        ema._swap_models(module)
    try:
        yield
    finally:
        for ema in averages:
            ema._swap_models(module)


def load_ema_weights(trainer: Trainer, module: LightningModule) -> None:
    """Give `module` the averaged weights for good, where its trainer has a WeightEMA."""
    for ema in _find_averages(trainer):
        ema._copy_average_to_current(module)


def select_trained_weights(trainer: Trainer, checkpoint: dict[str, Any]) -> None:
    """Make the weights in training those of `checkpoint`, in place of their average, where its
    trainer has no WeightEMA; the moments of the optimiser belong to them."""
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    averages = any(isinstance(callback, WeightEMA) for callback in callbacks)
    if not averages and "current_model_state" in checkpoint:
        checkpoint["state_dict"] = checkpoint["current_model_state"]
        checkpoint["callbacks"].pop(WeightEMA.__name__, None)  # Lightning would warn of its absence


def _find_averages(trainer: Trainer) -> list[WeightEMA]:
    callbacks = trainer.callbacks  # type: ignore[attr-defined]
    return [c for c in callbacks if isinstance(c, WeightEMA) and c._average_model is not None]
