"""One training of a lease: by wall time, with the rate brought to its end, exported as it goes."""

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import lightning
from lightning import Callback, LightningModule, Trainer
from omegaconf import OmegaConf

from scripts.lease.fit import Sized
from scripts.lease.plan import Plan
from src.app import build
from src.app.parts import make, part, rooms
from src.models import files
from src.sim.pipeline import Sample
from src.training import handover
from src.training.curve import Curve
from src.training.datamodule import LightFieldData
from src.training.schedule import Hours

ELSEWHERE = ("checkpoint", "rotation", "progress", "curve", "hours")  # callbacks of src.train
AGAIN = 1.5  # times the seconds of the last scoring are kept for the one at the end
SHORTEST_H = 1e-6


class Exporter(Curve):
    """The learning curve, which is exported with the weights at its lines, every `every_s` and when
    the training is cut: `publish` is given this and the module, the weights are in `export`.
    """

    def __init__(self, export: Path, every_h: float, every_s: float, publish: Callable):
        super().__init__(str(export.with_suffix(".csv")), every_h, str(export))
        self.every_s, self.publish = every_s, publish
        self.scoring_s, self.stored = 0.0, time.monotonic()

    @property
    def state_key(self) -> str:
        """That of the curve, which a training outside of leases goes on with."""
        return Curve.__qualname__

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs, batch, batch_idx: int
    ) -> None:
        """Score at a line; export when it is time."""
        super().on_train_batch_end(trainer, module, outputs, batch, batch_idx)
        if time.monotonic() - self.stored >= self.every_s:
            self._store(module)

    def _add(self, trainer: Trainer, module: LightningModule) -> None:
        start = time.monotonic()
        super()._add(trainer, module)
        self.scoring_s = time.monotonic() - start

    def _store(self, module: LightningModule) -> None:
        super()._store(module)
        self.publish(self, module)
        self.stored = time.monotonic()


class InTime(Callback):
    """Brings the cosine of `hours` to its end before `end` (time.monotonic), less the time that the
    scoring there takes, where steps, scores or the start take longer than was thought.
    """

    def __init__(self, hours: Hours, curve: Exporter, end: float):
        self.hours, self.curve, self.end, self.planned = hours, curve, end, hours.hours

    def on_train_batch_start(
        self, trainer: Trainer, module: LightningModule, batch, batch_idx: int
    ) -> None:
        """Set where the cosine ends."""
        left = self.end - time.monotonic() - AGAIN * self.curve.scoring_s
        most = max(module.clock.hours + left / 3600, SHORTEST_H)
        self.hours.hours = min(self.planned, most)


class HoursAnew(Hours):
    """A cosine that begins anew after the hours `since` that the weights have had."""

    def __init__(self, since: float, **options):
        super().__init__(**options)
        self.since = since

    def share(self, hours: float) -> float:
        """Return the rate after `hours` over that of the beginning."""
        length = max(self.hours - self.since, SHORTEST_H)
        return super().share(max(hours - self.since, 0.0) / length * self.hours)


def train(
    plan: Plan, one: Sized, *, seconds: float, end: float, folder: Path, publish: Callable
) -> None:
    """Train for `seconds`, and be over by `end` (time.monotonic).

    Weights on their way to `publish`, see Exporter, lie in `folder`.
    """
    cfg, before = one.cfg, plan.hours_before(one.network)
    cfg.hours, cfg.paths.run = before + seconds / 3600, str(folder)
    build.share_cores(cfg)
    build.keep_memory(cfg)
    build.choose_precision(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    net, spec = build.network(cfg)
    module, data = build.reconstructor(cfg, net, spec), build.data(cfg, ("train", "val"))
    data.validation_samples = Once(data)
    export = folder / f"{one.name}.safetensors"
    curve = Exporter(export, seconds / 3600 / plan.validate.times, plan.export_s, publish)
    hours = _hours(cfg, before if one.network.restart else None)
    others = [value for name, value in cfg.callbacks.items() if name not in ELSEWHERE]
    callbacks = [InTime(hours, curve, end), hours, curve]
    callbacks += [make(value, rooms(cfg)) for value in others]
    if one.network.start:
        start = files.require(plan.path(one.network.start), spec)
        handover.take(module, callbacks, start)
    quiet = {"logger": False, "enable_checkpointing": False}
    trainer = part(cfg, "trainer", callbacks=callbacks, **quiet)
    trainer.fit(module, data)
    if not trainer.global_step:
        raise ValueError("the time was over before its first step")


class Once:
    """The validation clips of `data`, simulated once: they are always the same."""

    def __init__(self, data: LightFieldData):
        self.samples, self.kept = data.validation_samples, []

    def __call__(self) -> Iterator[Sample]:
        self.kept = self.kept or list(self.samples())
        return iter(self.kept)


def _hours(cfg, since: float | None) -> Hours:
    options = OmegaConf.to_container(cfg.callbacks.hours, resolve=True)
    options.pop("_target_")
    return Hours(**options) if since is None else HoursAnew(since, **options)
