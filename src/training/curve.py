"""The learning curve: scores of fixed validation clips, a line for every hour or so of training."""

from copy import deepcopy
from pathlib import Path

import torch
from lightning import Callback, LightningModule, Trainer

from src.metrics.table import NAMES
from src.models import files
from src.records.results import csv_text, write_text
from src.training.idle import idle_share

PROBED = 3  # clips that show which channels are dead
COLLAPSED = 1.5  # times the least mean loss of a line so far


class Collapsed(ValueError):
    """The loss is far above what it was and does not come back, as when all channels are shut."""

    def __init__(self, losses: str, before: dict, export: Path | None):
        kept = f"; {export} holds the weights of {before['hours']:.2f} hours" if export else ""
        super().__init__(f"the training has collapsed: its mean loss is {losses}{kept}")


class Curve(Callback):
    """Score the validation clips at the start, every `every_h` hours of the module's clock and at
    the end (None: never); write all lines so far to the CSV file `path`.

    A line: hours, steps, windows trained on, mean training loss since the line before, the share of
    dead channels (`idle_share` over the first PROBED clips), scores.
    The lines are part of checkpoints, so that the file of a run that goes on begins at the
    beginning.
    `export`: also write the weights to this file (.safetensors, float16), at each line and when the
    training is cut short.  A training that has collapsed (its loss is COLLAPSED times what it was)
    is ended by a ValueError, and the export stays that of the line before.
    """

    def __init__(self, path: str, every_h: float | None = None, export: str | None = None):
        if every_h is not None and not every_h > 0:
            raise ValueError(f"callbacks.curve.every_h must be > 0 or null, got {every_h}")
        if export is not None and Path(export).suffix != ".safetensors":
            raise ValueError(f"export must be a .safetensors file or null, got {export}")
        self.path, self.every_h = Path(path), every_h
        self.export = Path(export) if export else None
        self.rows: list[dict] = []
        self.loss, self.steps = 0.0, 0
        self.first = 0  # line whose loss is of this training's kind

    def state_dict(self) -> dict:
        """Return what a checkpoint holds of the curve."""
        return {"rows": self.rows, "loss": self.loss, "steps": self.steps, "first": self.first}

    def load_state_dict(self, state_dict: dict) -> None:
        """Go on with the curve of a checkpoint."""
        self.rows, self.loss = list(state_dict["rows"]), state_dict["loss"]
        self.steps, self.first = state_dict["steps"], state_dict.get("first", 0)

    def go_on(self, rows: list[dict], loss: float, steps: int) -> None:
        """Go on with the lines of other weights, whose loss may have been another one."""
        self.rows, self.loss, self.steps, self.first = list(rows), loss, steps, len(rows)

    def on_train_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Write the lines there are; score the start."""
        if self.every_h is None or not trainer.is_global_zero:
            return
        if self.rows:
            self._write()
        else:
            self._add(trainer, module)

    def on_train_batch_end(
        self, trainer: Trainer, module: LightningModule, outputs, batch, batch_idx: int
    ) -> None:
        """Score when an hour is full, and at the end."""
        if self.every_h is None or not trainer.is_global_zero:
            return
        self.loss += float(trainer.callback_metrics["train/loss"])
        self.steps += 1
        full = module.clock.hours // self.every_h > self.rows[-1]["hours"] // self.every_h
        if full or trainer.should_stop or trainer.global_step == trainer.max_steps:
            self._add(trainer, module)

    def on_exception(self, trainer: Trainer, module: LightningModule, exception) -> None:
        """Export what a training that is cut short has learned."""
        if self.rows and trainer.is_global_zero and not isinstance(exception, Collapsed):
            self._store(module)

    def _add(self, trainer: Trainer, module: LightningModule) -> None:
        row = {
            "hours": module.clock.hours,
            "steps": module.steps,
            "windows": module.windows_seen,
            "loss": self.loss / self.steps if self.steps else "",
        }
        losses = [line["loss"] for line in [*self.rows[self.first :], row] if line["loss"] != ""]
        if losses and losses[-1] > COLLAPSED * min(losses):
            raise Collapsed(f"{losses[-1]:.3g} after {min(losses):.3g}", self.rows[-1], self.export)
        self.rows.append(row | scores(trainer, module))
        self.loss, self.steps = 0.0, 0
        self._write()
        self._store(module)
        module.clock.start()

    def _store(self, module: LightningModule) -> None:
        """Export the weights with all that a training needs to go on from them (handover.py)."""
        if self.export is None:
            return
        reached = {"hours": module.clock.hours, "windows": module.windows_seen}
        card = reached | {"steps": module.steps, "loss": self.loss, "curve": self.rows}
        # A copy: spectral norm is folded in eval mode, and the training goes on in its own.
        files.save(self.export, deepcopy(module.method), module.network_spec, card)

    def _write(self) -> None:
        heads = list(self.rows[-1])
        rows = [[row.get(name, "") for name in heads] for row in self.rows]
        write_text(self.path, csv_text(heads, rows))


@torch.no_grad()
def scores(trainer: Trainer, module: LightningModule) -> dict[str, float]:
    """Return the share of dead channels and the mean of every score, over the validation clips."""
    module.eval()  # the mean of the weights, if there is one, always is
    found, probed = [], []
    for sample in trainer.datamodule.validation_samples():
        found += module.measure(sample)
        if len(probed) < PROBED:
            probed.append(sample)
    dead = idle_share(module, probed)
    module.train()
    names = [name for name in NAMES if name in module.scores.names]
    means = {name: sum(clip[name] for clip in found) / len(found) for name in names}
    return {"idle": dead} | means
