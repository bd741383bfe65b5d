"""Runs of the doors in processes of their own that can be killed, and the count of what came of it.

A fork server imports the doors once; each run is forked from it, so that a run starts at once and
its signal handlers, limits and open files are its own.
"""

import json
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch
from omegaconf import OmegaConf

FORKS = multiprocessing.get_context("forkserver")
FORKS.set_forkserver_preload(
    ["src.train", "src.eval", "src.reconstruct", "baselines.highpass", "tests.faults.test_inputs"]
)
SLOWEST = 600.0  # seconds; a run that takes longer hangs, also on a machine at work


@dataclass
class Tally:
    """What was done and what came of it; printed when the test ends, whichever way."""

    name: str
    injected: int = 0
    recovered: int = 0
    lost: int = 0

    @contextmanager
    def run(self) -> Iterator[None]:
        """One run that is disturbed in the block: recovered at its end, lost if that raises."""
        try:
            yield
            self.recovered += 1
        except BaseException:
            self.lost += 1
            raise
        finally:
            print(
                f"{self.name}: {self.injected} faults injected, {self.recovered} runs recovered, "
                f"{self.lost} results lost"
            )


class Run:
    """`work(*arguments)` in a process of its own, as a door runs it; output in `log`."""

    def __init__(self, log: Path, work: Callable, *arguments):
        self.log = log
        log.parent.mkdir(parents=True, exist_ok=True)
        log.write_text("")
        self.process = FORKS.Process(target=_work, args=(str(log), work, arguments))
        self.process.start()

    def wait(self, seconds: float = SLOWEST) -> int:
        """Return the exit code, negative for the signal that ended the run."""
        self.process.join(seconds)
        if self.process.exitcode is None:
            self.process.kill()
            raise TimeoutError(f"the run hangs:\n{self.text()}")
        return self.process.exitcode

    def until(self, seen: Callable[[], bool]) -> bool:
        """Return True when `seen()`, False when the run ended before."""
        end = time.monotonic() + SLOWEST
        while self.process.exitcode is None:
            if seen():
                return True
            assert time.monotonic() < end, f"nothing happened:\n{self.text()}"
            time.sleep(0.005)
        return seen()

    def stop(self, number: int) -> int:
        """Send a signal, if the run is still there, and return the exit code."""
        if self.process.exitcode is None:
            os.kill(self.process.pid, number)
        return self.wait()

    def text(self) -> str:
        """Return what the run printed."""
        return self.log.read_text(errors="replace")


def _work(log: str, work: Callable, arguments: tuple) -> None:
    file = os.open(log, os.O_WRONLY | os.O_APPEND)
    os.dup2(file, 1)
    os.dup2(file, 2)
    sys.stdout = os.fdopen(1, "w", buffering=1)
    sys.stderr = os.fdopen(2, "w", buffering=1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    multiprocessing.set_start_method("fork", force=True)  # for loaders' workers, as of a door
    torch.set_num_threads(1)
    from src.app import door

    door.run(lambda: work(*arguments))


def train(config: str) -> None:
    """Run the door train on a resolved config (YAML)."""
    from src.train import train as work

    work(OmegaConf.create(config))


def evaluate(config: str) -> None:
    """Run the door eval."""
    from src.eval import evaluate as work

    work(OmegaConf.create(config))


def reconstruct(config: str) -> None:
    """Run the door reconstruct."""
    from src.reconstruct import reconstruct as work

    work(OmegaConf.create(config))


def outcome(run: Path) -> dict:
    """Return the numbers of a whole run: its scores and, of a training, its weights."""
    record = json.loads((run / "results.json").read_text())
    numbers = {"test": record["test"], "compared": record["compared"]}
    last = run / "checkpoints" / "last.ckpt"
    if last.is_file():
        state = torch.load(last, weights_only=True)["state_dict"]
        numbers["weights"] = {name: value.tolist() for name, value in state.items()}
    return numbers
