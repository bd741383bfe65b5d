"""Config, sample pictures and final metrics of a run for Weights & Biases."""

from collections.abc import Iterable
from itertools import count
from pathlib import Path

from lightning.pytorch.loggers import Logger, WandbLogger


def keep_earlier_metrics(run: Path) -> None:
    """Give the `metrics.csv` of an earlier training in `run` the next free number: the logger of
    the one that begins there would delete it."""
    file = run / "logs" / "metrics.csv"
    numbered = (file.with_suffix(f".{number}.csv") for number in count(1))
    if file.is_file():
        file.rename(next(path for path in numbered if not path.exists()))


def log_config_to_wandb(loggers: Iterable[Logger], config: dict) -> None:
    """Store `config` with the run of W&B, where it is among `loggers`."""
    for logger in _wandb(loggers):
        logger.log_hyperparams(config)


def log_results_to_wandb(loggers: Iterable[Logger], record: dict, pictures: Iterable[Path]) -> None:
    """Store the mean scores of `record`, the content of results.json, and sample pictures."""
    means = {name: value["mean"] for name, value in record["test"].items() if name != "clips"}
    for logger in _wandb(loggers):
        logger.experiment.summary.update({f"test/{name}": mean for name, mean in means.items()})
        for path in pictures:
            log = logger.log_video if path.suffix == ".gif" else logger.log_image
            log(f"samples/{path.stem}", [str(path)])


def _wandb(loggers: Iterable[Logger]) -> list[WandbLogger]:
    return [logger for logger in loggers if isinstance(logger, WandbLogger)]
