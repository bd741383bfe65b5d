"""What Weights & Biases is told of a run besides its curves: config, pictures, final metrics."""

import sys
from collections.abc import Iterable
from pathlib import Path

from lightning.pytorch.loggers import Logger, WandbLogger


def begin(loggers: Iterable[Logger], config: dict) -> None:
    """Store the whole config with the run of W&B, where it is among `loggers`."""
    for logger in _wandb(loggers):
        logger.experiment.config.update(config)


def end(loggers: Iterable[Logger], record: dict, pictures: Iterable[Path]) -> None:
    """Store the means of `record`, the content of results.json, and the sample pictures."""
    means = {name: value["mean"] for name, value in record["test"].items() if name != "clips"}
    for logger in _wandb(loggers):
        import wandb

        logger.experiment.summary.update({f"test/{name}": mean for name, mean in means.items()})
        shown = {path.stem: _picture(wandb, path) for path in pictures}
        logger.experiment.log({f"samples/{name}": picture for name, picture in shown.items()})


def close() -> None:
    """End the run of W&B, if there is one: the next job of a multirun would write into it."""
    if "wandb" in sys.modules:
        sys.modules["wandb"].finish()


def _wandb(loggers: Iterable[Logger]) -> list[WandbLogger]:
    return [logger for logger in loggers if isinstance(logger, WandbLogger)]


def _picture(wandb, path: Path):
    return wandb.Video(str(path), format="gif") if path.suffix == ".gif" else wandb.Image(str(path))
