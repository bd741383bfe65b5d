"""One training of a campaign: a process that can be found, stopped and started again."""

import fcntl
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import torch
from omegaconf import OmegaConf

from scripts.learning_curves import curve
from src.models import files

ROOT = Path(__file__).resolve().parents[1]
# In the command lines of a training and of what it starts: filters of warnings are handed on, and
# no warning begins with this word.
MARK = "ignore:campaign-child"


class Stop(NamedTuple):
    """When a training has come to its end early: LPIPS gains less than `gain`, a share of it, in
    `hours`."""

    hours: float
    gain: float


class Campaign(NamedTuple):
    """What all trainings of a campaign share; see conf/campaign/default.yaml."""

    out: str
    export: str
    common: list[str]
    at_once: int
    threads: int
    nice: int
    tries: int
    stop: Stop | None


class Training:
    """One training: its folder `out/name` with a folder for every part it came in, lock and log."""

    def __init__(
        self,
        plan: Campaign,
        name: str,
        hours: float,
        experiment: str | None = None,
        overrides: tuple[str, ...] | list[str] = (),
        least: float = 0.0,
    ):
        if not isinstance(hours, int | float) or not 0 < hours < 1e4:
            raise ValueError(f"trainings: hours of {name} must be > 0, got {hours}")
        self.plan, self.name, self.hours, self.least = plan, name, hours, least
        self.experiment, self.overrides = experiment or name, list(overrides)
        self.folder = Path(plan.out) / name
        self.export = Path(plan.export) / f"{name}.safetensors"
        self.failures, self.began = 0, 0.0
        self.process: subprocess.Popen | None = None

    def command(self) -> list[str]:
        """Return the command of the next part."""
        parts = sorted(self.folder.glob("part*"))
        number = int(parts[-1].name[4:]) + 1 if parts else 0
        start = self.folder if any(self.folder.rglob("*.ckpt")) else self.export
        return [
            "nice", "-n", str(self.plan.nice), sys.executable, "-W", MARK, "-m", "src.train",
            f"experiment={self.experiment}", f"hours={self.hours}",
            *self.plan.common, *self.overrides,
            f"export={self.export}", f"hydra.run.dir={self.folder / f'part{number:03}'}",
            "~callbacks.progress", *([f"ckpt={start}"] if start.exists() else []),
        ]  # fmt: skip

    def start(self) -> None:
        """Start the next part; it holds the lock until it ends."""
        self.folder.mkdir(parents=True, exist_ok=True)
        self._tidy()
        lock = os.open(self.folder / "lock", os.O_RDWR | os.O_CREAT)
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        environment = os.environ | {"OMP_NUM_THREADS": str(self.plan.threads)}
        with (self.folder / "log.txt").open("a") as log:
            command, self.began = self.command(), time.time()
            self.process = subprocess.Popen(
                command, cwd=ROOT, env=environment, stdin=subprocess.DEVNULL, stdout=log,
                stderr=log, pass_fds=(lock,), start_new_session=True,
            )  # fmt: skip
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
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
        if self.process is not None:
            self.process.wait()  # its lock is free a moment before it can be looked up as ended
        return False

    def terminate(self) -> None:
        """Ask a part that runs to store itself and end."""
        text = (self.folder / "lock").read_text()
        if self.running() and text:
            os.kill(int(text), signal.SIGTERM)

    def state(self) -> str:
        """Return running, done, stopped (early), failed or waiting."""
        if self.running():
            return "running"
        if self._done():
            return "done"
        for name in ("stopped", "failed"):
            if (self.folder / f"{name}.txt").is_file():
                return name
        return "waiting"

    def settle(self) -> None:
        """Note how a part ended that this has started; too many failures end a training."""
        if self.process is None or self.process.poll() is None:
            return
        code, self.process = self.process.returncode, None
        moved = any(path.stat().st_mtime > self.began for path in self.folder.rglob("*.ckpt"))
        self.failures = 0 if moved or code == 0 else self.failures + 1
        if self.failures >= self.plan.tries:
            said = (self.folder / "log.txt").read_text(errors="replace").splitlines()[-1:]
            (self.folder / "failed.txt").write_text(f"exit code {code}: {' '.join(said)}\n")

    def curve(self) -> list[dict[str, float]]:
        """Return the learning curve so far."""
        return curve(self.folder) or self._exported().get("curve", [])

    def flat(self) -> bool:
        """Return whether the last hours brought too little for more to follow."""
        if not self.plan.stop:
            return False
        stop, rows = self.plan.stop, self.curve()
        if not rows or "lpips" not in rows[-1] or rows[-1]["hours"] < max(self.least, stop.hours):
            return False
        now = rows[-1]
        before = [row for row in rows if row["hours"] <= now["hours"] - 0.95 * stop.hours]
        return bool(before) and now["lpips"] > (1 - stop.gain) * before[-1]["lpips"]

    def end_early(self) -> None:
        """Stop a training that gains nothing more."""
        row = self.curve()[-1]
        (self.folder / "stopped.txt").write_text(
            f"{row['hours']:.2f} h, LPIPS {row['lpips']:.4f}\n"
        )
        self.terminate()

    def line(self) -> str:
        """Return the line of `status`."""
        hours, steps, age = self._reached()
        rows = self.curve()
        last = rows[-1] if rows else {}
        names = ("hours", "lpips", "ssim", "psnr_aligned", "wobble")
        told = ", ".join(f"{name} {last[name]:.4g}" for name in names if name in last)
        stored = f", stored {age / 60:.0f} min ago" if age is not None else ""
        return (
            f"{self.name}: {self.state()}, {hours:.2f} of {self.hours:g} h, {steps} steps{stored}"
            f"{'; at ' + told if told else ''}"
        )

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
        return files.card(self.export) if self.export.is_file() else {}

    def _done(self) -> bool:
        """Return whether a part has its results, or weights, of the hours asked for now."""
        for results in self.folder.glob("part*/results.json"):
            config = OmegaConf.load(results.with_name("config.yaml"))
            if config.hours >= self.hours:
                return True
        return self._exported().get("hours", 0.0) >= self.hours

    def _tidy(self) -> None:
        """Keep the checkpoints of the newest part that has some."""
        parts = [part for part in sorted(self.folder.glob("part*")) if any(part.rglob("*.ckpt"))]
        for path in (path for part in parts[:-2] for path in part.rglob("*.ckpt")):
            path.unlink()
