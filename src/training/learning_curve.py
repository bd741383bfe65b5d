"""The learning curve of a training, which is exported with its weights and continued from there."""

from collections.abc import Iterable
from copy import deepcopy
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, Trainer

from src.losses.terms import TrainingLoss
from src.metrics.table import mean_score
from src.models import files
from src.records.atomic import write_text
from src.records.results import format_csv
from src.training.ema import use_averaged_weights
from src.training.reconstructor import Reconstructor

COLLAPSE_FACTOR = 1.5  # of the mean loss over the least of all rows so far
LEAST_STEPS = 50  # of a row whose mean loss counts for that
TRAINING_STATE = "reached"  # key of what a training continues from, in the card of shipped weights


class LearningCurve(Callback):
    """Score the validation clips at the start, every `interval_h` hours of the module's clock and
    at the end (None: never); write all rows so far to the CSV file `path`.

    A row: hours, steps, windows trained on, mean training loss since the row before, scores.  The
    rows are part of checkpoints.  `export`: also write the weights to this file (.safetensors,
    float16), at each row and when the training is cut short.  Raises ValueError for
    values out of range and, keeping the export of the row before, where the loss has risen to
    COLLAPSE_FACTOR times its least over rows of LEAST_STEPS steps, as when no gradient reaches the
    network any more.
    """

    def __init__(self, path: str, interval_h: float | None = None, export: str | None = None):
        if interval_h is not None and not interval_h > 0:
            key = "callbacks.learning_curve.interval_h"
            raise ValueError(f"{key} must be > 0 or null, got {interval_h}")
        if export is not None and Path(export).suffix != ".safetensors":
            raise ValueError(f"export must be a .safetensors file or null, got {export}")
        if export is not None and interval_h is None:
            key = "callbacks.learning_curve.interval_h"
            raise ValueError(f"{key} must be > 0 where export is given, got null")
        self.path, self.interval_h = Path(path), interval_h
        self.export = Path(export) if export else None
        self.rows: list[dict] = []
        self.loss, self.steps = 0.0, 0  # since the last row
        self.losses: list[float] = []  # of rows that are compared
        self.loss_terms = ""  # of which these are the sum

    def state_dict(self) -> dict:
        kept = ("rows", "loss", "steps", "losses", "loss_terms")
        return {key: getattr(self, key) for key in kept}

    def load_state_dict(self, state_dict: dict) -> None:
        vars(self).update(state_dict)

    def on_train_start(self, trainer: Trainer, pl_module: Any) -> None:
        if self.interval_h is None or not trainer.is_global_zero:
            return
        self._forget_other_loss(pl_module.loss)
        if self.rows:
            self._write()
        else:
            self.score_and_export(trainer, pl_module)

    def on_train_batch_end(self, trainer: Trainer, pl_module: Any, *_: Any) -> None:
        if self.interval_h is None or not trainer.is_global_zero:
            return
        self.loss += float(trainer.callback_metrics["train/loss"])
        self.steps += 1
        before, now = self.rows[-1]["hours"], pl_module.clock.hours
        is_due = now // self.interval_h > before // self.interval_h
        if is_due or trainer.should_stop or trainer.global_step == trainer.max_steps:
            self.score_and_export(trainer, pl_module)

    def on_fit_end(self, trainer: Trainer, pl_module: Any) -> None:
        """Export where nothing was left to train."""
        if self.rows and self.export and trainer.is_global_zero and not self.export.is_file():
            self.export_weights(pl_module)

    def on_exception(self, trainer: Trainer, pl_module: Any, exception: BaseException) -> None:
        if self.rows and trainer.is_global_zero:
            self.export_weights(pl_module)

    def score_and_export(self, trainer: Trainer, module: Reconstructor) -> None:
        """Score the validation clips, write the row, export the weights."""
        row = {
            "hours": module.clock.hours,
            "steps": module.steps_so_far,
            "windows": module.windows_seen,
            "loss": self.loss / self.steps if self.steps else "",
        }
        if self.steps >= LEAST_STEPS:
            self.losses.append(self.loss / self.steps)
            self._check_collapse()
        self.rows.append(row | mean_validation_scores(trainer, module))
        self.loss, self.steps = 0.0, 0
        self._write()
        self.export_weights(module)
        module.clock.start()

    def _check_collapse(self) -> None:
        now, least = self.losses[-1], min(self.losses)
        if now > COLLAPSE_FACTOR * least:
            text = f"its mean loss is {now:.3g} after {least:.3g}"
            if self.export:
                text += f"; {self.export} holds the weights of {self.rows[-1]['hours']:.2f} hours"
            self.export = None  # so that these are kept
            raise ValueError(f"the training has collapsed: {text}")

    def _forget_other_loss(self, loss: TrainingLoss) -> None:
        """Compare no loss with those of rows before, where it is another sum of terms."""
        terms = loss.terms.items()
        now = ", ".join(f"{t.weight:g} {name}: {type(t).__name__}" for name, t in terms)
        if self.loss_terms not in ("", now):
            self.losses, self.loss, self.steps = [], 0.0, 0
        self.loss_terms = now

    def export_weights(self, module: Reconstructor) -> None:
        """Write the (averaged) weights with all that a training needs to continue from them."""
        if self.export is None:
            return
        reached = {"hours": module.clock.hours, "windows": module.windows_seen}
        card = reached | {"steps": module.steps_so_far, "loss": self.loss, "curve": self.rows}
        with use_averaged_weights(module):
            # A copy: spectral norm is folded in eval mode, and the training continues in its own.
            files.save(self.export, deepcopy(module.network), module.network_spec, card)

    def _write(self) -> None:
        heads = list(self.rows[-1])
        rows = [[row.get(name, "") for name in heads] for row in self.rows]
        write_text(self.path, format_csv(heads, rows))


@torch.no_grad()
def mean_validation_scores(trainer: Trainer, module: Reconstructor) -> dict[str, float | None]:
    """Return the mean of every score over the validation clips, of the averaged weights."""
    module.eval()
    with use_averaged_weights(module):
        samples = trainer.datamodule.validation_samples()  # type: ignore[attr-defined]
        clips = [scores for sample in samples for scores in module.reconstruct_and_score(sample)[1]]
    module.metrics.reset()
    module.train()
    return {name: mean_score(clip[name] for clip in clips) for name in module.metrics.names}


def read_training_progress(weights: Path) -> dict:
    """Return hours, windows, steps, the loss since the last row of the curve, and the curve so far
    of the file `weights`: a LearningCurve's export, or shipped weights of a training with one.

    Raises ValueError for weights that were written otherwise.
    """
    card = files.read_card(weights)
    card = card.get(TRAINING_STATE, card)
    if "curve" not in card:
        allowed = "a checkpoint or weights with a learning curve"
        raise ValueError(f"ckpt must be {allowed}, got {weights}; start= begins from any weights")
    return card


def check_hours_left(train_hours: float | None, weights: Path) -> None:
    """Raise ValueError where a training of `train_hours` (None: no limit) that goes on from the
    file `weights` has no time left, and as `read_training_progress` does."""
    hours = read_training_progress(weights)["hours"]
    if train_hours is not None and train_hours <= hours:
        allowed = f"> {hours:g}, the hours of ckpt={weights}"
        raise ValueError(f"train_hours must be {allowed}, got {train_hours:g}")


def continue_from_weights(
    module: Reconstructor, callbacks: Iterable[Callback], weights: Path
) -> None:
    """Give `module` the weights, time, steps and windows, and the curve among `callbacks` the rows
    of the file `weights`; the optimiser starts anew.  Raises as `read_training_progress` does.
    """
    before = read_training_progress(weights)
    files.restore_weights(module.network, weights)
    module.clock.seconds, module.windows_seen = 3600 * before["hours"], before["windows"]
    module.earlier_steps = before["steps"]
    for curve in (found for found in callbacks if isinstance(found, LearningCurve)):
        curve.rows, curve.loss = list(before["curve"]), before["loss"]
        curve.steps = before["steps"] - curve.rows[-1]["steps"]
