"""What every door (train, eval, simulate ...) shares: a job's folder, its errors, its end."""

import hashlib
import logging
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import rich
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from lightning.pytorch.utilities.exceptions import SIGTERMException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from rich.syntax import Syntax

from src.records import results, tracking

FAILED = "failed.txt"  # in the folder of a sweep's job: why it failed
LONGEST = 200  # characters of such a folder's name


def one_folder(overrides: str) -> str:
    """Return `overrides` as the name of one folder: no slashes, and not too long for a disk."""
    name = overrides.replace("/", "-")
    if len(name) <= LONGEST:
        return name
    return f"{name[: LONGEST - 9]}_{hashlib.sha256(overrides.encode()).hexdigest()[:8]}"


OmegaConf.register_new_resolver("one_folder", one_folder, replace=True)


class JobFailed(Exception):
    """A job of the sweep in this folder has failed; the others went on."""


def run(main: Callable[[], None]) -> None:
    """Call the Hydra entry point `main`; a wrong value ends in one line on stderr and exit code 2.

    A sweep with failed jobs ends with their names and exit code 1.  `HYDRA_FULL_ERROR=1` makes
    Hydra hand the errors of the job to us instead of printing them.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    start = time.time()
    try:
        main()
    except JobFailed as error:
        sys.exit(_name_failed(Path(str(error)), start))
    except (ValueError, HydraException, OmegaConfBaseException) as error:
        sys.exit(_refuse(error))
    except KeyboardInterrupt:
        sys.exit(128 + signal.SIGINT)
    except SIGTERMException:  # Lightning's; it would end with exit code 0
        sys.exit(128 + signal.SIGTERM)
    except OSError as error:  # a full disk, a file that may not be read
        _refuse(error)
        sys.exit(1)
    except SystemExit as error:  # Lightning makes an exit code 1 of Ctrl-C
        interrupted = isinstance(error.__context__, KeyboardInterrupt)
        sys.exit(128 + signal.SIGINT if interrupted else error.code)


def job(work: Callable[[DictConfig], object], cfg: DictConfig) -> None:
    """Run `work` in the folder Hydra made for this job; print the config once; end W&B's run.

    A job of a sweep is skipped where its results stand; its error is stored.
    """
    cfg.paths.run = HydraConfig.get().runtime.output_dir
    _quieten()
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        _job_of_sweep(work, cfg)
    else:
        _job(work, cfg)


def _job(work: Callable[[DictConfig], object], cfg: DictConfig) -> None:
    rich.print(Syntax(resolved(cfg), "yaml", background_color="default"))
    try:
        work(cfg)
    finally:
        tracking.close()


def _job_of_sweep(work: Callable[[DictConfig], object], cfg: DictConfig) -> None:
    folder, name = Path(cfg.paths.run), " ".join(HydraConfig.get().overrides.task)
    (folder / FAILED).unlink(missing_ok=True)
    try:
        if results.standing(folder, resolved(cfg)):
            print(f"skipped, its results stand: {name}, in {folder}")
        else:
            _job(work, cfg)
    except SIGTERMException:  # ends the sweep, as Ctrl-C does
        raise KeyboardInterrupt from None
    except Exception as error:
        reason = " ".join(str(error).split())
        print(f"failed: {name}: {reason}", file=sys.stderr)
        results.write_text(folder / FAILED, f"{name}\n{traceback.format_exc()}")
        raise JobFailed(HydraConfig.get().sweep.dir) from error


def _name_failed(sweep: Path, start: float) -> int:
    """Print the jobs of `sweep` that failed after `start` (seconds since the epoch)."""
    files = sorted(file for file in sweep.rglob(FAILED) if file.stat().st_mtime >= start - 1)
    print(f"error: {len(files)} failed; the others are done.  Failed:", file=sys.stderr)
    for file in files:
        print(f"  {file.read_text().splitlines()[0]}: see {file}", file=sys.stderr)
    return 1


def resolved(cfg: DictConfig) -> str:
    """Return the whole config as YAML, interpolations filled in."""
    return OmegaConf.to_yaml(cfg, resolve=True)


def facts(cfg: DictConfig, start: float) -> dict:
    """Return what `results.json` says of a run besides its numbers; `start` by perf_counter."""
    gpu = cfg.trainer.accelerator == "gpu" and torch.cuda.is_available()
    cpu = f"cpu, {torch.get_num_threads()} threads"
    return {
        "task": cfg.task,
        "experiment": cfg.name,
        "seed": cfg.seed,
        "asked": asked(),
        "resumed_from": cfg.ckpt if cfg.task == "train" else None,
        "wall_s": round(time.perf_counter() - start, 1),
        "device": torch.cuda.get_device_name() if gpu else cpu,
    }


def asked() -> dict:
    """Return what was asked for on the command line: config, group choices, overrides.

    Empty where no command line was (a door called as a function).
    """
    if not HydraConfig.initialized():
        return {}
    hydra = HydraConfig.get()
    groups = {group: choice for group, choice in hydra.runtime.choices.items() if choice}
    return {
        "config": hydra.job.config_name,
        "choices": {group: choice for group, choice in groups.items() if "hydra/" not in group},
        "overrides": list(hydra.overrides.task),
    }


def _quieten() -> None:
    """Drop what Lightning says in every run and is expected here."""
    for expected in (
        "The dirpath has changed",  # a resumed run has a folder of its own
        "You're resuming from a checkpoint that ended",  # our sampler starts at the step reached
        "Experiment logs directory",  # a job of a sweep that starts again
        "Checkpoint directory",
        "Using ModelCheckpoint with manual optimization",  # what follows the step is what we want
        ".*LeafSpec",  # inside Lightning 2.6 with torch 2.13
    ):
        warnings.filterwarnings("ignore", expected)
    for chatty in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
        logging.getLogger(chatty).setLevel(logging.WARNING)


def _refuse(error: Exception) -> int:
    print("error: " + " ".join(str(error).split()), file=sys.stderr)
    return 2
