"""Train a network on simulated light fields and test it: python -m src.train experiment=lf3x3."""

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from omegaconf import DictConfig

from src.app import build, entry_point, hardware, start_weights
from src.app.instantiate import as_dict, build_part
from src.figures import samples
from src.models import files
from src.records import results, tracking
from src.training.datamodule import LightFieldData
from src.training.ema import load_ema_weights
from src.training.learning_curve import continue_from_weights
from src.training.reconstructor import Reconstructor
from src.training.step_guard import NonFiniteError


def train(cfg: DictConfig) -> dict:
    """Fit, test beside what it began as, the `references` and the high-pass, write `results.json`.

    Everything goes below `cfg.paths.run`.  Returns the content of `results.json`; of several
    processes that train together all but the first train only, and return {}.
    """
    run, start = Path(cfg.paths.run), time.perf_counter()
    hardware.reserve_worker_cores(cfg)
    hardware.retain_freed_memory(cfg)
    lightning.seed_everything(cfg.seed, workers=True, verbose=False)
    first_weights = fill_in_settings(cfg)
    references = start_weights.load_reference_networks(cfg)
    if cfg.reference_baseline:
        references[cfg.reference_baseline.name] = build_part(cfg, "reference_baseline.method")
    net, spec = build.build_untrained_network(cfg)
    if first_weights:
        files.restore_weights(net, first_weights)
    ckpt = files.find_checkpoint(cfg.ckpt, spec) if cfg.ckpt else None
    module, data = build.build_reconstructor(cfg, net, spec), build.build_data_module(cfg)
    trainer = build.build_trainer(cfg)
    if trainer.global_rank:
        fit(trainer, module, data, ckpt)
        return {}
    results.create_run_folder(run, entry_point.resolved_yaml(cfg))
    tracking.keep_earlier_metrics(run)
    beginning = start_weights.label_before_training(cfg, first_weights)
    before, _ = build.test_method(cfg, beginning, module.method, data, module.metrics)
    tracking.log_config_to_wandb(trainer.loggers, as_dict(cfg))
    try:
        fit(trainer, module, data, ckpt)
    except NonFiniteError as error:
        same = f"python -m src.simulate like={run}/config.yaml split=train index={error.clips[0]}"
        raise ValueError(f"{error}; seed {cfg.seed}; to see the clip: {same}") from error
    load_ema_weights(trainer, module)
    # As it is when it is loaded again.
    module.method.to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    tested = module.method, data, module.metrics
    with print_checkpoint_on_failure(trainer):
        trained, drawn = build.test_method(cfg, cfg.name, *tested, cfg.sample_clips)
        others = [build.test_method(cfg, *o, data, module.metrics)[0] for o in references.items()]
    pictures = samples.write_samples(run / "samples", drawn)
    rows, facts = [trained, before, *others], entry_point.run_metadata(cfg, start)
    note = results.describe_score_difference(trained, before)
    config = entry_point.resolved_yaml(cfg)
    record = results.write_and_print_results(run, config, rows, note=note, **facts)
    tracking.log_results_to_wandb(trainer.loggers, record, pictures)
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
    """Train; when that is cut short, whatever by, print what to continue from."""
    last = find_checkpoint_folder(trainer) / "last.ckpt"
    if ckpt and files.is_weights_file(ckpt):
        continue_from_weights(module, trainer.callbacks, ckpt)  # type: ignore[attr-defined]
        ckpt = None
    with print_checkpoint_on_failure(trainer):
        trainer.fit(module, data, ckpt_path=ckpt)
        if not last.is_file():  # nothing was left to do
            trainer.save_checkpoint(last)


def find_checkpoint_folder(trainer: lightning.Trainer) -> Path:
    """Return the folder of the checkpoints of a training."""
    checkpoint = trainer.checkpoint_callback
    assert isinstance(checkpoint, ModelCheckpoint) and checkpoint.dirpath
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
            print(f"stopped at step {step}; go on with ckpt={folder}", file=sys.stderr)
        raise


if __name__ == "__main__":
    entry_point.run_command(train, "train", fill_in_settings)
