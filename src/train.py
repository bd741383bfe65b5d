"""Train a network on simulated light fields and test it: python -m src.train experiment=lf3x3."""

import shlex
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import DictConfig
from torch import Tensor

from src import COMMAND
from src.app import build, entry_point, hardware, start_weights
from src.app.instantiate import as_dict, build_part
from src.figures import samples
from src.models import files
from src.models.network import VideoMethod
from src.records import results, tracking
from src.records.results import ScoreRow
from src.sim.pipeline import Sample
from src.training.datamodule import LightFieldData
from src.training.ema import load_ema_weights
from src.training.learning_curve import check_hours_left, continue_from_weights
from src.training.reconstructor import Reconstructor
from src.training.step_guard import NonFiniteError

Drawn = list[tuple[Sample, Tensor]]  # clips and their reconstructions


def train(cfg: DictConfig) -> dict:
    """Fit, test beside what it began as, the `references` and the high-pass, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`; of several
    processes that train together all but the first train only, and return {}.
    """
    start, first_weights = time.perf_counter(), _prepare(cfg)
    references = _load_references(cfg)
    training = _build_training(cfg, first_weights)
    if training.trainer.global_rank:
        fit(*training)
        return {}
    _create_run_folder(cfg)
    before, _ = _test(cfg, start_weights.label_before_training(cfg, first_weights), training)
    tracking.log_config_to_wandb(training.trainer.loggers, as_dict(cfg))
    _fit_or_name_bad_clip(cfg, training)
    trained, drawn, others = _test_trained(cfg, training, references)
    return _write_results(cfg, start, training, [trained, before, *others], drawn)


class Training(NamedTuple):
    """What is trained, by what and on what; `ckpt`: what it goes on from."""

    trainer: lightning.Trainer
    module: Reconstructor
    data: LightFieldData
    ckpt: Path | None


def _prepare(cfg: DictConfig) -> Path | None:
    """Set up the process and the settings; return the file of `start`."""
    hardware.reserve_worker_cores(cfg)
    hardware.retain_freed_memory(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    return fill_in_settings(cfg)


def _load_references(cfg: DictConfig) -> dict[str, VideoMethod]:
    """Return the `references` and the `reference_baseline` by their names in the table."""
    references = start_weights.load_reference_networks(cfg)
    if cfg.reference_baseline:
        references[cfg.reference_baseline.name] = build_part(cfg, "reference_baseline.method")
    return references


def _build_training(cfg: DictConfig, first_weights: Path | None) -> Training:
    net, spec = build.build_untrained_network(cfg)
    if first_weights:
        files.restore_weights(net, first_weights)
    ckpt = files.find_checkpoint(cfg.ckpt, spec) if cfg.ckpt else None
    if ckpt and files.is_weights_file(ckpt):
        check_hours_left(cfg.train_hours, ckpt)
    module, data = build.build_reconstructor(cfg, net, spec), build.build_data_module(cfg)
    trainer = build.build_trainer(cfg)
    find_checkpoint_folder(trainer)  # or its error would come late
    return Training(trainer, module, data, ckpt)


def _create_run_folder(cfg: DictConfig) -> None:
    run = Path(cfg.paths.run)
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    tracking.keep_earlier_metrics(run)


def _fit_or_name_bad_clip(cfg: DictConfig, training: Training) -> None:
    """Train; raises ValueError, with the command that shows its clip, for a loss that is no
    number."""
    try:
        fit(*training)
    except NonFiniteError as error:
        config = f"{Path(cfg.paths.run)}/config.yaml"
        which = f"index={error.clips[0]}{' large=true' if error.is_large else ''}"
        same = f"{COMMAND}simulate {shlex.quote(f'like={config}')} split=train {which}"
        raise ValueError(f"{error}; seed {cfg.seed}; to see the clip: {same}") from error


def _test(
    cfg: DictConfig, name: str, training: Training, method: VideoMethod | None = None,
    kept_clips: int = 0,
) -> tuple[ScoreRow, Drawn]:  # fmt: skip
    """Test `method`, None: the network that is trained, as `build.test_method`."""
    module, data = training.module, training.data
    return build.test_method(cfg, name, method or module.method, data, module.metrics, kept_clips)


def _test_trained(
    cfg: DictConfig, training: Training, references: Mapping[str, VideoMethod]
) -> tuple[ScoreRow, Drawn, list[ScoreRow]]:
    """Return the scores of the trained network, its drawn clips, and the scores of the others."""
    load_ema_weights(training.trainer, training.module)
    # As it is when it is loaded again.
    training.module.method.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    with print_checkpoint_on_failure(training.trainer):
        trained, drawn = _test(cfg, cfg.name, training, kept_clips=cfg.sample_clips)
        others = [_test(cfg, name, training, net)[0] for name, net in references.items()]
    return trained, drawn, others


def _write_results(
    cfg: DictConfig, start: float, training: Training, rows: list[ScoreRow], drawn: Drawn
) -> dict:
    """Write samples and `results.json` of `rows`, the trained network first, what it began as
    second; return the content of the latter."""
    run = Path(cfg.paths.run)
    pictures = samples.write_samples(run / "samples", drawn)
    facts = entry_point.run_metadata(cfg, start)
    note = results.describe_score_difference(*rows[:2])
    config = entry_point.resolved_yaml(cfg)
    record = results.write_and_print_results(run, config, rows, note=note, **facts)
    tracking.log_results_to_wandb(training.trainer.loggers, record, pictures)
    return record


def fill_in_settings(cfg: DictConfig) -> Path | None:
    """Set what follows from the machine and from `start`; return the file of the latter.

    Raises ValueError for a precision or a `start` that cannot be.
    """
    hardware.fill_in_precision(cfg)
    return start_weights.set_model_from_start_weights(cfg)


def fit(
    trainer: lightning.Trainer, module: Reconstructor, data: LightFieldData, ckpt: Path | None
) -> None:
    """Train; when that is cut short, whatever by, print what to continue from.

    Of several processes all use the folder of the first.
    """
    if ckpt and files.is_weights_file(ckpt):
        continue_from_weights(module, trainer.callbacks, ckpt)  # type: ignore[attr-defined]
        ckpt = None
    with print_checkpoint_on_failure(trainer):
        trainer.fit(module, data, ckpt_path=ckpt)
        if not module.steps_so_far:
            limits = "trainer.max_steps, trainer.limit_train_batches and train_hours"
            raise ValueError(f"{limits} must let a training take a step, got none")
        last = find_checkpoint_folder(trainer) / "last.ckpt"  # now that of the first process
        if trainer.strategy.broadcast(not last.is_file()):  # nothing was left to do
            trainer.save_checkpoint(last)


def find_checkpoint_folder(trainer: lightning.Trainer) -> Path:
    """Return the folder of the checkpoints of a training.

    Raises ValueError where no callback names one.
    """
    checkpoint = trainer.checkpoint_callback
    if not (isinstance(checkpoint, ModelCheckpoint) and checkpoint.dirpath):
        raise ValueError("callbacks must have a ModelCheckpoint with a dirpath, got none")
    return Path(checkpoint.dirpath)


@contextmanager
def print_checkpoint_on_failure(trainer: lightning.Trainer) -> Iterator[None]:
    """Print what to continue from where the training, or the test after it, is cut short."""
    try:
        yield
    except BaseException:
        folder = find_checkpoint_folder(trainer)
        if any(folder.glob("*.ckpt")):
            step = trainer.global_step
            ckpt = shlex.quote(f"ckpt={folder}")
            print(f"stopped at step {step}; go on with {ckpt}", file=sys.stderr)
        raise


if __name__ == "__main__":
    entry_point.run_command(train, "train", fill_in_settings)
