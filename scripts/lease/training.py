"""One training of a lease: by wall time, with the rate brought to its end, exported as it goes."""

import functools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning
from lightning import LightningModule, Trainer
from omegaconf import OmegaConf

from scripts.lease.plan import Plan, start_path
from scripts.lease.selection import SizedNetwork
from src.app import build, hardware
from src.app.instantiate import build_part, instantiate_node, read_user_packages
from src.models import files
from src.training.ema import WeightEMA
from src.training.learning_curve import LearningCurve, continue_from_weights
from src.training.schedule import CosineSchedule

REPLACED_CALLBACKS = ("checkpoint", "rotation", "progress", "learning_curve", "schedule")
SCORING_MARGIN = 1.5  # times the seconds of the last scoring are kept for the one at the end
MIN_HOURS = 1e-6


class ExportingCurve(LearningCurve):
    """A learning curve that also exports every `export_interval_s`; after each export `publish` is
    given this and the module.
    """

    def __init__(
        self, export: Path, interval_h: float, export_interval_s: float, publish: Callable
    ):
        super().__init__(str(export.with_suffix(".csv")), interval_h, str(export))
        self.export_interval_s, self.publish = export_interval_s, publish
        self.scoring_s, self.exported_at = 0.0, time.monotonic()

    @property
    def state_key(self) -> str:
        """That of the curve, with which a training outside of leases continues."""
        return LearningCurve.__qualname__

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs, batch, batch_idx: int
    ) -> None:
        """Score when a row is due; export when it is time."""
        super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)
        if time.monotonic() - self.exported_at >= self.export_interval_s:
            self.export_weights(pl_module)

    def score_and_export(self, trainer: Trainer, module: LightningModule) -> None:
        """Note how long scoring takes."""
        start = time.monotonic()
        super().score_and_export(trainer, module)
        self.scoring_s = time.monotonic() - start

    def export_weights(self, module: LightningModule) -> None:
        """Export and publish."""
        super().export_weights(module)
        self.publish(self, module)
        self.exported_at = time.monotonic()


class DeadlineSchedule(CosineSchedule):
    """A cosine that begins at `start_hours` of the module's clock and ends before `deadline`
    (time.monotonic), less the time that the scoring of `curve` takes there.
    """

    def __init__(self, start_hours: float, deadline: float, curve: ExportingCurve, **options: Any):
        super().__init__(**options)
        self.start_hours, self.deadline, self.curve = start_hours, deadline, curve
        self.planned_hours = self.train_hours or 0.0

    def on_train_batch_start(
        self, trainer: Trainer, pl_module: LightningModule, batch, batch_idx: int
    ) -> None:
        """Set where the cosine ends, then the learning rate."""
        self.limit_train_hours(pl_module.clock.hours)
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)

    def limit_train_hours(self, hours: float) -> None:
        """Let a cosine that is at `hours` end before the deadline."""
        left = self.deadline - time.monotonic() - SCORING_MARGIN * self.curve.scoring_s
        self.train_hours = min(self.planned_hours, max(hours + left / 3600, MIN_HOURS))

    def lr_ratio(self, hours: float) -> float:
        """Return the learning rate after `hours` over that of the beginning."""
        end = self.train_hours or 0.0
        length = max(end - self.start_hours, MIN_HOURS)
        return super().lr_ratio(max(hours - self.start_hours, 0.0) / length * end)


def train_network(
    plan: Plan, one: SizedNetwork, *, seconds: float, deadline: float, folder: Path,
    publish: Callable,
) -> None:  # fmt: skip
    """Train for `seconds`, and be over by `deadline` (time.monotonic).

    Weights on their way to `publish`, see ExportingCurve, lie in `folder`.  Raises ValueError where
    no step was taken.
    """
    cfg, earlier = one.cfg, plan.earlier_hours(one.network)
    cfg.train_hours, cfg.paths.run = earlier + seconds / 3600, str(folder)
    hardware.reserve_worker_cores(cfg)
    hardware.retain_freed_memory(cfg)
    hardware.fill_in_precision(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    net, spec = build.build_untrained_network(cfg)
    module = build.build_reconstructor(cfg, net, spec)
    data = build.build_data_module(cfg, ("train", "val"))
    simulate = data.validation_samples
    data.validation_samples = functools.cache(lambda: list(simulate()))  # kept on the device
    export = folder / f"{one.name}.safetensors"
    curve = ExportingCurve(
        export, seconds / 3600 / plan.validate.count, plan.export_interval_s, publish
    )
    options = OmegaConf.to_container(cfg.callbacks.schedule, resolve=True)
    options.pop("_target_")
    average = [] if cfg.ema_decay is None else [WeightEMA(cfg.ema_decay)]
    callbacks = [*average, DeadlineSchedule(earlier, deadline, curve, **options), curve]
    callbacks += [
        instantiate_node(node, read_user_packages(cfg))
        for name, node in cfg.callbacks.items()
        if name not in REPLACED_CALLBACKS
    ]
    if one.network.start:
        weights = files.find_checkpoint(start_path(plan.folder, one.network.start), spec)
        continue_from_weights(module, callbacks, weights)
    quiet = {"logger": False, "enable_checkpointing": False}
    trainer = build_part(cfg, "trainer", callbacks=callbacks, **quiet)
    trainer.fit(module, data)
    if not trainer.global_step:
        raise ValueError("the time was over before its first step")
