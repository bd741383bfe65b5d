"""What every door (train, eval, simulate ...) shares: a job's folder, its errors, its end."""

import logging
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable

import rich
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.syntax import Syntax


def run(main: Callable[[], None]) -> None:
    """Call the Hydra entry point `main`; a wrong value ends in one line on stderr and exit code 2.

    `HYDRA_FULL_ERROR=1` makes Hydra hand the errors of the job to us instead of printing them.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    try:
        main()
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        sys.exit(_refuse(error))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except SIGTERMException:  # Lightning's; it would end with exit code 0
        sys.exit(128 + signal.SIGTERM)


def job(work: Callable[[DictConfig], object], cfg: DictConfig) -> None:
    """Run `work` in the folder Hydra made for this job; print the config once; end W&B's run."""
    cfg.paths.run = HydraConfig.get().runtime.output_dir
    _quieten()
    rich.print(Syntax(resolved(cfg), "yaml", background_color="default"))
    try:
        work(cfg)
    finally:
        if "wandb" in sys.modules:  # else the next job of a multirun would write into this run
            sys.modules["wandb"].finish(quiet=True)


def resolved(cfg: DictConfig) -> str:
    """Return the whole config as YAML, interpolations filled in."""
    return OmegaConf.to_yaml(cfg, resolve=True)


def facts(cfg: DictConfig, start: float) -> dict:
    """Return what `results.json` says of a run besides its numbers; `start` by perf_counter."""
    gpu = cfg.trainer.accelerator == "gpu" and torch.cuda.is_available()
    return {
        "task": cfg.task,
        "experiment": cfg.name,
        "seed": cfg.seed,
        "resumed_from": cfg.ckpt if cfg.task == "train" else None,
        "wall_s": round(time.perf_counter() - start, 1),
        "device": torch.cuda.get_device_name()
        if gpu
        else f"cpu, {torch.get_num_threads()} threads",
    }


def _quieten() -> None:
    """Drop what Lightning says in every run and is expected here."""
    for expected in (
        "The dirpath has changed",  # a resumed run has a folder of its own
        "You're resuming from a checkpoint that ended",  # our sampler starts at the step reached
        ".*LeafSpec",  # inside Lightning 2.6 with torch 2.13
    ):
        warnings.filterwarnings("ignore", expected)
    for chatty in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _refuse(error: Exception) -> int:
    print("error: " + " ".join(str(error).split()), file=sys.stderr)
    return 2
