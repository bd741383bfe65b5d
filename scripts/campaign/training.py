"""A stage that trains: a process that can be found, stopped and started again."""

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import OmegaConf

from scripts.campaign.recipe import ROOT
from scripts.learning_curves import read_curve
from src.models import files

# In the command lines of a training and of what it starts: filters of warnings are handed on, and
# no warning begins with this word.
MARK = "ignore:campaign-child"
WRONG_VALUE = 2  # exit code of a training that would end so again


class Settings(NamedTuple):
    """What all trainings of a campaign share: threads and priority (19: lowest) of each.

    `max_failures`: in a row, without a new checkpoint, after which a training is given up.
    `overrides`: of src.train, above those of a recipe and its stages.
    """

    out: Path = Path("out/campaign")
    parallel: int = 2
    threads: int = 1
    nice: int = 19
    max_failures: int = 3
    overrides: Sequence[str] = ()


class Training:
    """A training in `folder`, with a folder for every part it came in, a lock and a log.

    `weights`: the file of its newest weights.
    """

    def __init__(self, settings: Settings, folder: Path, hours: float):
        self.settings, self.folder, self.hours = settings, folder, hours
        self.weights = folder.with_suffix(".safetensors")
        self.log, self.failed = folder / "log.txt", folder / "failed.txt"
        self.failures, self.began = 0, 0.0
        self.process: subprocess.Popen | None = None

    def command(self, overrides: Sequence[str], start: str | None) -> list[str]:
        """Return the command of the next part; `start`: weights that the first goes on from."""
        parts = sorted(self.folder.glob("part*"))
        number = int(parts[-1].name[4:]) + 1 if parts else 0
        if self.weights.exists():
            start = str(self.weights)
        if any(self.folder.rglob("*.ckpt")):
            start = str(self.folder)
        return [
            "nice", "-n", str(self.settings.nice), sys.executable, "-W", MARK, "-m", "src.train",
            *overrides, f"train_hours={self.hours}", f"export={self.weights}",
            f"hydra.run.dir={self.folder / f'part{number:03}'}",
            "trainer.enable_progress_bar=false",
            *([f"ckpt={start}"] if start else []),
        ]  # fmt: skip

    def start(self, overrides: Sequence[str], start: str | None) -> None:
        """Start the next part, as `command` says; it holds the lock until it ends."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._remove_old_checkpoints()
        lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT)
        fcntl.flock(lock, fcntl.LOCK_EX)  # `status` looks at it for a moment
        environment = os.environ | {"OMP_NUM_THREADS": str(self.settings.threads)}
        with self.log.open("a") as log:
            command, self.began = self.command(overrides, start), time.time()
            self.process = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=log,
                stderr=log, pass_fds=(lock,), start_new_session=True,
            )  # fmt: skip
        give_way(self.process.pid, self.settings.nice)
        os.ftruncate(lock, 0)
        os.pwrite(lock, str(self.process.pid).encode(), 0)
        os.close(lock)

    def running(self) -> bool:
        """Return whether a part runs, whoever has started it."""
        if self.process is not None:
            self.process.poll()  # or a dead one stays a zombie
        if not self.folder.is_dir():
            return False
        with (self.folder / "lock").open("a") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        if self.process is not None:
            self.process.wait()  # its lock is free a moment before it can be looked up as ended
        return False

    def terminate(self) -> None:
        """Ask a part that runs to store itself and end."""
        lock = self.folder / "lock"
        if lock.is_file() and self.running() and (text := lock.read_text()):
            os.kill(int(text), signal.SIGTERM)

    def state(self) -> str:
        """Return running, done, failed or waiting."""
        if self.running():
            return "running"
        if self._done():
            return "done"
        return "failed" if self.failed.is_file() else "waiting"

    def settle(self) -> None:
        """Note how a part that this has started ended; too many failures, or a wrong value, end a
        training."""
        if self.process is None or self.process.poll() is None:
            return
        code, self.process = self.process.returncode, None
        moved = any(path.stat().st_mtime > self.began for path in self.folder.rglob("*.ckpt"))
        self.failures = 0 if moved or code == 0 else self.failures + 1
        if self.failures >= self.settings.max_failures or code == WRONG_VALUE:
            last = self.log.read_text(errors="replace").splitlines()[-1:]
            self.failed.write_text(f"exit code {code}: {' '.join(last)}\n")

    def reason(self) -> str:
        """Return why this training has failed and where its log is."""
        return f"{self.failed.read_text().strip()}; log: {self.log}"

    def progress(self) -> str:
        """Return hours, steps and the last scores of the learning curve, in one line."""
        hours, steps, age = self._reached()
        rows = read_curve(self.folder) or self._exported().get("curve", [])
        last = rows[-1] if rows else {}
        names = ("hours", "lpips", "ssim", "psnr_aligned", "temporal_jitter_px")
        scores = ", ".join(f"{name} {last[name]:.4g}" for name in names if name in last)
        stored = f", stored {age / 60:.0f} min ago" if age is not None else ""
        at = f"; at {scores}" if scores else ""
        return f"{hours:.2f} of {self.hours:g} h, {steps} steps{stored}{at}"

    def _reached(self) -> tuple[float, int, float | None]:
        """Return hours and steps of the newest checkpoint, and its age in s."""
        found = sorted(self.folder.rglob("*.ckpt"), key=lambda path: path.stat().st_mtime)
        for path in found[::-1]:
            try:
                content = torch.load(path, weights_only=True, mmap=True)
                age = time.time() - path.stat().st_mtime
                steps = content.get("steps", content["global_step"])
                return content["seconds"] / 3600, steps, age
            except Exception:  # it was just removed, or torn: all kinds of errors
                continue
        card = self._exported()
        return card.get("hours", 0.0), card.get("steps", 0), None

    def _exported(self) -> dict:
        """Return the card of the exported weights: all that may be left of a training."""
        return files.read_card(self.weights) if self.weights.is_file() else {}

    def _done(self) -> bool:
        """Return whether there are weights, with results or a card of the hours asked for now."""
        if not self.weights.is_file():
            return False
        for results in self.folder.glob("part*/results.json"):
            config = OmegaConf.load(results.with_name("config.yaml"))
            if config.train_hours >= self.hours:
                return True
        return self._exported().get("hours", 0.0) >= self.hours

    def _remove_old_checkpoints(self) -> None:
        """Keep the checkpoints of the two newest parts that have some."""
        parts = [part for part in sorted(self.folder.glob("part*")) if any(part.rglob("*.ckpt"))]
        for path in (path for part in parts[:-2] for path in part.rglob("*.ckpt")):
            path.unlink()


def give_way(pid: int, nice: int) -> None:
    """Give the session of a process the priority `nice` too, as far as the kernel lets it.

    Linux shares processors evenly among sessions, whatever `nice` their processes have (sched(7),
    autogroup).
    """
    group = Path(f"/proc/{pid}/autogroup")
    with contextlib.suppress(OSError):
        group.write_text(str(nice))
