"""What all entry points share: the folder of a run, errors, exit codes."""

import functools
import json
import logging
import os
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from src.app import console
from src.app.compose import describe_config_error
from src.app.config_files import CONF
from src.app.config_values import check_values
from src.app.help import show_help
from src.app.path_overrides import (
    name_job_folder,
    quote_paths,
    refuse_empty_paths,
    unquote_override,
)
from src.app.renamed_keys import refuse_renamed_keys
from src.app.stop_signals import StoppedBySignal, stop_by_signals
from src.models import files
from src.models.checkpoints import list_checkpoints
from src.records import results
from src.records.atomic import write_text
from src.records.overrides import read_override_key
from src.records.run_lock import hold_run_folder

FAILURE_FILE = "failed.txt"  # in the folder of a sweep's job: why it failed

OmegaConf.register_new_resolver("one_folder", name_job_folder, replace=True)


class JobFailed(Exception):
    """A job of the sweep in this folder failed; the others ran."""


def run_command(
    work: Callable[[DictConfig], object], config: str, fill_in: Callable | None = None
) -> None:
    """Run `work` on `conf/<config>.yaml` and the overrides of the command line, as `run_main`.

    `fill_in` sets what `work` would set in the config: the results of a sweep's job are compared
    with it.
    """
    failures: list[Exception] = []

    @hydra.main(version_base=None, config_path=CONF, config_name=config)
    @functools.wraps(work)
    def main(cfg: DictConfig) -> None:
        try:
            run_job(work, cfg, fill_in)
        except Exception as error:
            if HydraConfig.get().runtime.choices.get("hydra/launcher") != "basic":
                raise  # a process of its own
            failures.append(error)  # Hydra would print it, and go on to raise it

    def run() -> None:
        if show_help(config, Path(work.__code__.co_filename)):
            return
        main()
        if failures:
            raise failures[0]

    run_main(run)


def run_main(main: Callable[[], None]) -> None:
    """Call the Hydra entry point `main`; a wrong value ends in one line on stderr and exit code 2.

    A sweep with failed jobs ends with their names and exit code 1.  Paths on the command line are
    quoted for Hydra's grammar.  `HYDRA_FULL_ERROR=1` makes Hydra hand the errors of the job to us
    instead of printing them.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"
    start = time.time()
    console.prepare_streams()
    sys.argv[1:] = quote_paths(sys.argv[1:], Path(sys.argv[0]).stem)
    try:
        with stop_by_signals():
            refuse_empty_paths(sys.argv[1:], Path(sys.argv[0]).stem)
            main()
    except JobFailed as error:
        _print_failed_jobs(Path(str(error)), start)
        sys.exit(1)
    except _value_errors() as error:
        if isinstance(error, OSError) and (why := _reason_against_folder_of_run(error)):
            wanted = "hydra.run.dir must be a folder, new or there"
            error = ValueError(f"{wanted}, got {error.filename}: {why}")
        message = describe_config_error(error, Path(sys.argv[0]).stem)
        is_io = isinstance(error, OSError) and not isinstance(error, HydraException)
        console.exit_with_error(message, 1 if is_io else 2)  # 1: a full disk, an unreadable file
    except _stop_errors() as error:
        interrupted = isinstance(error, KeyboardInterrupt)
        print("stopped", file=sys.stderr)
        sys.exit(128 + (signal.SIGINT if interrupted else signal.SIGTERM))
    except SystemExit as error:  # Lightning makes an exit code 1 of Ctrl-C
        interrupted = isinstance(error.__context__, KeyboardInterrupt)
        if interrupted or isinstance(error, StoppedBySignal):
            print("stopped", file=sys.stderr)
        sys.exit(128 + signal.SIGINT if interrupted else error.code)


def _value_errors() -> tuple[type[Exception], ...]:
    """Return what a wrong value, or the disk, raises; Lightning's error where it is loaded."""
    lightning = sys.modules.get("lightning.fabric.utilities.exceptions")
    ours = (ValueError, HydraException, OmegaConfBaseException, OSError)
    return (*ours, *([lightning.MisconfigurationException] if lightning else []))


def _stop_errors() -> tuple[type[BaseException], ...]:
    """Return what Ctrl-C and SIGTERM raise: Lightning's, where it is loaded, would end a process
    with exit code 0."""
    lightning = sys.modules.get("lightning.pytorch.utilities.exceptions")
    return (KeyboardInterrupt, *([lightning.SIGTERMException] if lightning else []))


def _reason_against_folder_of_run(error: OSError) -> str | None:
    """Return why Hydra cannot make the folder of the run; None where `error` is another."""
    if isinstance(error, FileExistsError | NotADirectoryError):
        why = "a file is in the way"
    elif isinstance(error, FileNotFoundError | PermissionError):
        why = "it cannot be made there"
    else:
        return None
    files_of_frames = [Path(f.filename) for f in traceback.extract_tb(error.__traceback__)]
    callers = [file for file in files_of_frames if file.name not in ("pathlib.py", "os.py")]
    return why if callers[-1].parts[-3:] == ("hydra", "core", "utils.py") else None


def run_job(
    work: Callable[[DictConfig], object], cfg: DictConfig, fill_in: Callable | None = None
) -> None:
    """Run `work` in the folder Hydra made for this job, alone in it; end W&B's run.

    A job of a sweep is skipped where its results stand and the weights it tests are older; its
    error is stored.  Raises ValueError where another process works in the folder, and for a folder
    that is typed as `paths.run`.
    """
    refuse_renamed_keys(cfg)
    job = HydraConfig.get()
    if is_set_on_command_line("paths.run"):
        why = "of a sweep: hydra.sweep.dir=FOLDER"
        raise ValueError(
            f"paths.run must be set as hydra.run.dir=FOLDER, {why}, got {cfg.paths.run}"
        )
    cfg.paths.run = job.runtime.output_dir
    check_values(cfg)
    _silence_expected_warnings()
    folder, name = Path(cfg.paths.run), " ".join(map(unquote_override, job.overrides.task))
    if job.mode != RunMode.MULTIRUN:
        with hold_run_folder(folder):
            _run_work(work, cfg)
        return
    try:
        with hold_run_folder(folder):
            _run_unless_done(work, cfg, name, fill_in)
    except _stop_errors():  # ends the sweep
        raise KeyboardInterrupt from None
    except Exception as error:
        said = " ".join(console.cut_worker_traceback(str(error)).split())
        print(f"failed: {name}: {said}", file=sys.stderr)
        write_text(folder / FAILURE_FILE, f"{name}\n{traceback.format_exc()}")
    else:
        (folder / FAILURE_FILE).unlink(missing_ok=True)
        return
    raise JobFailed(job.sweep.dir)  # not from `error`, which would keep all that the job made


def _run_unless_done(
    work: Callable[[DictConfig], object], cfg: DictConfig, name: str, fill_in: Callable | None
) -> None:
    """Run `work` of the sweep's job `name`; where its results stand print that it is skipped."""
    if fill_in:
        fill_in(cfg)
    folder = Path(cfg.paths.run)
    stored = results.has_results(folder, resolved_yaml(cfg))
    if stored and cfg.get("task") == "train":
        _check_same_beginning(cfg, folder / "results.json")
    if stored and not _has_newer_weights(cfg, folder / "results.json"):
        code = _describe_other_code(folder / "results.json")
        print(f"skipped, its results stand: {name}, in {folder}{code}")
    else:
        _run_work(work, cfg)


def _check_same_beginning(cfg: DictConfig, stored: Path) -> None:
    """Raise ValueError where the training of the results `stored` went on from other weights than
    `ckpt`; what it was resumed from does not matter."""
    before = json.loads(stored.read_text()).get("resumed_from")
    paths = [files.locate(name) if name else Path() for name in (before, cfg.ckpt)]
    weights = [path.resolve() if files.is_weights_file(path) else None for path in paths]
    if weights[0] != weights[1]:
        wanted, got = ("no weights" if path is None else path for path in weights)
        raise ValueError(f"ckpt must be {wanted}, as of the results in {stored}, got {got}")


def _describe_other_code(stored: Path) -> str:
    """Return the version of the code of the results `stored`, "" where it is the present one."""
    before, now = json.loads(stored.read_text()).get("git"), results.git_commit()
    return "" if before == now else f"; of code at {before}, which is now at {now}"


def _has_newer_weights(cfg: DictConfig, stored: Path) -> bool:
    """Return whether a file of the weights that are tested is younger than the results `stored`."""
    if cfg.get("task") == "train":
        return False
    names = [cfg.get("ckpt"), OmegaConf.select(cfg, "baseline.weights")]
    paths = [files.locate(name) for name in names if isinstance(name, str)]
    found = [f for path in paths for f in (list_checkpoints(path) if path.is_dir() else [path])]
    return any(f.stat().st_mtime > stored.stat().st_mtime for f in found if f.is_file())


def _run_work(work: Callable[[DictConfig], object], cfg: DictConfig) -> None:
    try:
        work(cfg)
    finally:
        finish_wandb()


def finish_wandb() -> None:
    """End the run of W&B, if there is one: the next job of a multirun would write into it."""
    if "wandb" in sys.modules:
        sys.modules["wandb"].finish()


def _print_failed_jobs(sweep: Path, start: float) -> None:
    """Print the jobs of `sweep` that failed after `start` (seconds since the epoch)."""
    files = sorted(file for file in sweep.rglob(FAILURE_FILE) if file.stat().st_mtime >= start - 1)
    print(f"error: {len(files)} failed; the others are done.  Failed:", file=sys.stderr)
    for file in files:
        print(f"  {file.read_text().splitlines()[0]}: see {file}", file=sys.stderr)


def resolved_yaml(cfg: DictConfig) -> str:
    """Return the whole config as YAML, interpolations filled in."""
    return OmegaConf.to_yaml(cfg, resolve=True)


def run_metadata(cfg: DictConfig, perf_counter_start_s: float) -> dict:
    """Return what `results.json` says of a run besides its numbers."""
    gpu = cfg.trainer.accelerator == "gpu" and torch.cuda.is_available()
    cpu = f"cpu, {torch.get_num_threads()} threads"
    return {
        "task": cfg.task,
        "experiment": cfg.name,
        "seed": cfg.seed,
        "asked": describe_hydra_command(),
        "resumed_from": cfg.ckpt if cfg.task == "train" else None,
        "wall_s": round(time.perf_counter() - perf_counter_start_s, 1),
        "device": torch.cuda.get_device_name() if gpu else cpu,
    }


def describe_hydra_command() -> dict:
    """Return the config, group choices and overrides of the command line; {} without one."""
    if not HydraConfig.initialized():
        return {}
    job = HydraConfig.get()
    groups = {group: choice for group, choice in job.runtime.choices.items() if choice}
    return {
        "config": job.job.config_name,
        "choices": {group: choice for group, choice in groups.items() if "hydra/" not in group},
        "overrides": list(map(unquote_override, job.overrides.task)),
    }


def is_set_on_command_line(key: str) -> bool:
    """Return whether the command line sets `key`."""
    overrides = describe_hydra_command().get("overrides", [])
    return key in map(read_override_key, overrides)


def _silence_expected_warnings() -> None:
    """Drop what Lightning warns of in every run and is expected here."""
    for expected in (
        "The dirpath has changed",  # a resumed run has a folder of its own
        "You're resuming from a checkpoint that ended",  # our sampler starts at the step reached
        "Experiment logs directory",  # a job of a sweep that starts again
        "Checkpoint directory",
        "Using ModelCheckpoint with manual optimization",  # saved after the step, as wanted
        ".*LeafSpec",  # inside Lightning 2.6 with torch 2.13
    ):
        warnings.filterwarnings("ignore", expected)
    for chatty in ("lightning.pytorch.utilities.rank_zero", "lightning.fabric.utilities.rank_zero"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
