"""Filling a bank: one process in the background of a training, or several beforehand."""

import fcntl
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Sequence

import torch

from src.training.bank import Bank

PATIENCE = 2.0  # seconds between two looks at whether another process still fills


class Filler:
    """A process of lowest priority that makes the clips that banks lack, one bank after the other.

    Of all trainings that share a bank one fills it; when it ends, another goes on.  It ends with
    the banks full, with `stop`, and with the process that started it, whatever became of that.
    """

    def __init__(self, *banks: Bank):
        self.banks, self.process = banks, None

    def status(self) -> str:
        """Return a line for each bank."""
        return "\n".join(bank.status() for bank in self.banks)

    def start(self) -> None:
        """Start filling, where there is something to fill."""
        if any(bank.missing() for bank in self.banks):
            spawn = multiprocessing.get_context("spawn")  # a fork would take locks of threads along
            arguments = (self.banks, os.getpid())
            self.process = spawn.Process(target=_in_background, args=arguments, daemon=True)
            self.process.start()

    def stop(self) -> None:
        """End the process; a clip it was making is not there."""
        if self.process is not None:
            self.process.kill()
            self.process.join()
            self.process = None


def fill(
    bank: Bank,
    going: Callable[[], bool] = lambda: True,
    device: torch.device | str = "cpu",
) -> None:
    """Make what is missing and nobody else makes, on `device`, while `going()`.

    Raises OSError where a clip could not be kept.
    """
    for index in bank.missing():
        if not going():
            return
        with bank.claim(index, wait=False) as mine:
            if mine and not bank.path(index).exists():
                bank.make(index, device)
                if not bank.path(index).exists():
                    raise OSError(f"the bank in {bank.folder} cannot be filled")


def _in_background(banks: Sequence[Bank], parent: int) -> None:
    os.nice(19)
    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent

    def going() -> bool:
        return os.getppid() == parent

    for bank in banks:
        with (bank.folder / "filler.lock").open("ab") as file:
            while going() and not _locked(file):
                time.sleep(PATIENCE)
            try:
                fill(bank, going)
            except (OSError, ValueError) as error:  # the training goes on, and meets it if it must
                print(f"filling stops: {error}", file=sys.stderr)


def _locked(file) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
