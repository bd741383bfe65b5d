"""Runs of entry points in processes of their own that can be killed, and the count of what came.

A fork server imports the entry points once; each run is forked from it, so that a run starts at
once and its signal handlers, limits and open files are its own.
"""

import hashlib
import json
import multiprocessing
import os
import runpy
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from multiprocessing import forkserver
from pathlib import Path

import cv2
import numpy as np
import torch
from omegaconf import OmegaConf

import src
from src.app.stop_signals import TERMINATING

FORKS = multiprocessing.get_context("forkserver")
PRELOADED = ("src.train", "src.eval", "src.reconstruct", "baselines.highpass")
LATE = (  # what a run would import or load, each time anew, once it is under way
    "src.sim.scenes.photographs", "src.sim.turbulence.simulated", "src.training.checkpoint_io",
    "src.training.interruption", "tests.faults.loaded_kernels",
)  # fmt: skip
FORKS.set_forkserver_preload([*PRELOADED, *LATE, "tests.faults.test_damaged_files"])
MAX_RUN_S = 600.0  # a run that takes longer hangs, also on a machine at work


@dataclass
class Tally:
    """Counts the faults injected into runs, and prints them when a test ends."""

    name: str
    injected: int = 0

    @contextmanager
    def run(self) -> Iterator[None]:
        """A run that is disturbed in the block: recovered at its end, lost if that raises."""
        end = "0 runs recovered, 1 results lost"
        try:
            yield
            end = "1 runs recovered, 0 results lost"
        finally:
            print(f"{self.name}: {self.injected} faults injected, {end}")


class Run:
    """`work(*arguments)` in a process of its own, output in `log`; as an entry point runs it, or
    where it is a `program` as it stands: what ends that in one line is its own.
    """

    def __init__(self, log: Path, work: Callable, *arguments, program: bool = False):
        self.log = log
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text("")
        forkserver.ensure_running()
        server = forkserver._forkserver._forkserver_address
        self.process = FORKS.Process(
            target=_work, args=(str(log), server, program, work, arguments)
        )
        self.process.start()

    def wait(self, seconds: float = MAX_RUN_S) -> int:
        """Return the exit code, negative for the signal that ended the run."""
        self.process.join(seconds)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(f"the run hangs:\n{self.text()}")
        return self.process.exitcode

    def wait_until(self, condition: Callable[[], bool]) -> bool:
        """Return True when `condition()`, False when the run ended before."""
        end = time.monotonic() + MAX_RUN_S
        while self.process.exitcode is None:
            if condition():
                return True
            assert time.monotonic() < end, f"nothing happened:\n{self.text()}"
            time.sleep(0.005)
        return condition()

    def stop(self, number: int) -> int:
        """Send a signal, if the run is still there, and return the exit code."""
        if self.process.exitcode is None:
            os.kill(self.process.pid, number)
        return self.wait()

    def text(self) -> str:
        """Return what the run printed."""
        return self.log.read_text(errors="replace")


def leave_slices_out(_rows: object, path: Path, **_: object) -> None:
    """Leave a picture of one pixel."""
    path.write_bytes(cv2.imencode(".png", np.zeros((1, 1), np.uint8))[1].tobytes())


def _work(log: str, server: str, program: bool, work: Callable, arguments: tuple) -> None:
    # Those that the run forks come from the same server, not from one that imports all anew.
    forkserver._forkserver._forkserver_address = server
    forkserver._forkserver.ensure_running = int
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(file, number)
        setattr(sys, name, os.fdopen(number, "w", buffering=1, closefd=False))
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in TERMINATING:
        signal.signal(number, signal.SIG_DFL)  # not ignored as under nohup
    multiprocessing.set_start_method("fork", force=True)  # for loaders' workers, as of a run
    torch.set_num_threads(1)
    from src.app import entry_point
    from src.figures import samples

    samples.draw_comparison = leave_slices_out
    if program:
        work(*arguments)
    else:
        entry_point.run_main(lambda: work(*arguments))


def run_entry_point(name: str, config: str) -> None:
    """Run src.train, src.eval or src.reconstruct on a resolved config (YAML)."""
    function = "evaluate" if name == "eval" else name
    getattr(import_module(f"src.{name}"), function)(OmegaConf.create(config))


def run_program(name: str, *words: str) -> None:
    """Run `python -m src.<name>` with the words of a command line."""
    sys.argv = [name, *words]
    runpy.run_path(str(Path(src.__file__).with_name(f"{name}.py")), run_name="__main__")


def outcome(run: Path) -> dict:
    """Return the numbers of a whole run: its scores and, of a training, digests of its weights."""
    record = json.loads((run / "results.json").read_text())
    numbers = {"test": record["test"], "compared": record["compared"]}
    last = run / "checkpoints" / "last.ckpt"
    if last.is_file():
        state = torch.load(last, weights_only=True)["state_dict"]
        numbers["weights"] = {
            name: hashlib.sha256(value.numpy().tobytes()).hexdigest()
            for name, value in state.items()
        }
    return numbers
