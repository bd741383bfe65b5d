"""A time-limited training on one device: check, fill, train, validate, export, end in time."""

import json
import logging
import os
import sys
import threading
import time
import traceback
import warnings
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule
from lightning.pytorch.utilities.exceptions import SIGTERMException

from scripts.lease import probe
from scripts.lease.export import TABLES, Exports
from scripts.lease.fill import check_memory, fill_all
from scripts.lease.fit import Fit, Sized, allotted, overhead
from scripts.lease.plan import MIB, Plan
from scripts.lease.training import Exporter, train
from src.metrics.table import NAMES
from src.records import results
from src.training.device_cache import DeviceCache
from src.training.step_time import SpeedSplit

LAST_S = 3.0  # before the end of a lease, when whatever still runs is ended


class Lease:
    """What `fit` has chosen of `plan`, on `device`, from `began` (time.monotonic) on for
    `minutes`."""

    def __init__(
        self,
        plan: Plan,
        fit: Fit,
        minutes: float,
        began: float,
        exports: Exports,
        device: probe.Device,
    ):
        self.plan, self.fit, self.exports, self.device = plan, fit, exports, device
        self.began, self.end = began, began + 60 * minutes
        self.profile: dict[str, Any] = {"commit": results.commit(), "minutes": minutes}
        self.networks: dict[str, dict] = {one.name: {} for one in fit.networks}
        self.profile |= {"left_out": fit.left_out, "check": {}, "caches": []}
        self.profile["networks"] = self.networks
        self.rows: dict[str, list[dict]] = {}
        self.trials: dict[str, probe.Trial] = {}
        self.filled: list[DeviceCache] = []  # the caches that are
        self.stopped = ""  # why nothing more is begun
        self.exporting = threading.Lock()

    def run(self) -> int:
        """Do it all; return the exit code: 0 where something was trained."""
        threading.Thread(target=self._watch, daemon=True).start()
        for name, reason in self.fit.left_out.items():
            self.say(f"{name} is left out: {reason}")
        self._check()
        for place, one in enumerate(self.fit.networks):
            if self.stopped:
                self._undone(one.name, self.stopped)
                continue
            try:
                self._network(one, self.fit.networks[place:])
            except (KeyboardInterrupt, SystemExit, SIGTERMException):
                self.stopped = "the lease was told to end"
                self._undone(one.name, self.stopped)
            except Exception as error:  # whatever becomes of one, the others are trained
                traceback.print_exc()
                self._undone(one.name, _in_one_line(error))
        self._tables()
        self.exports.close()
        return self._exit_code()

    def say(self, text: str) -> None:
        """Print a line with the second of the lease."""
        print(f"[{time.monotonic() - self.began:4.0f} s] {text}", flush=True)

    def _check(self) -> None:
        """Print what the device is and does with each network; fall back where it has to."""
        until = time.monotonic() + self.plan.check_s
        for line in self.device.lines():
            self.say(line)
        self.profile["device"] = vars(self.device)
        for one in self.fit.networks:
            if not self.device.bf16:
                one.cfg.trainer.precision = "32-true"
            try:
                trial = probe.try_steps(one.cfg, self.device, until, self.say)
            except Exception as error:  # the training may go all the same, or says it again
                traceback.print_exc()
                self.say(f"{one.name}: the trial failed: {_in_one_line(error)}")
                trial = probe.Trial(one.cfg.data.batch_size)
            self.trials[one.name] = trial
            self.profile["check"][one.name] = vars(trial)
            speed = "no time for a trial" if time.monotonic() > until else "not tried"
            if trial.steps_per_s is not None:
                speed = f"{trial.steps_per_s:.2f} steps/s, {trial.step}"
                speed += f", {trial.memory / probe.GIB:.1f} GiB" * bool(trial.memory)
            self.say(f"{one.name}: {one.params:,} parameters, batch {trial.batch}, {speed}")

    def _network(self, one: Sized, rest: list[Sized]) -> None:
        """Fill the cache of a network, where it is another, and train it."""
        if one.caches and one.caches != self.filled:
            for cache in self.filled:
                cache.release()
            self.filled, wanted = [], self.plan.fill
            self.profile["caches"] += fill_all(
                one.caches, wanted, self.device, self.trials[one.name], self.say
            )
            self.filled = one.caches
        probe.free_memory(self.device.kind)  # what the network before held
        now, minutes = time.monotonic(), one.network.minutes
        fixed = overhead(self.plan, rest) - self.plan.check_s
        fixed -= self.plan.margin_s / 2  # of the beginning
        fixed -= 60 * self.plan.fill.minutes * bool(one.caches)
        seconds = allotted([other.network for other in rest], self.end - now - fixed)[0]
        if seconds < (30 * minutes if one.network.optional else 1):
            raise ValueError(f"{seconds:.0f} s are left for its {minutes:g} minutes")
        self.say(f"{one.name} trains for {seconds / 60:.2f} minutes")
        self._train(one, now + seconds)
        row = self.rows[one.name][-1]
        told = ", ".join(f"{name} {row[name]:.4g}" for name in NAMES if name in row)
        self.say(f"{one.name} is trained: {told}")

    def _train(self, one: Sized, until: float) -> None:
        """Train a network until `until`, and score it then; where the check had no time to find out
        that a batch does not fit the memory, with half of it.
        """

        def publish(curve: Exporter, module: LightningModule) -> None:
            self._export(one, curve, module)

        end, data = until + self.plan.validate.seconds, one.cfg.data
        while True:
            seconds = until - time.monotonic()
            try:
                return train(
                    self.plan, one, seconds=seconds, end=end, folder=self.exports.beside,
                    publish=publish,
                )  # fmt: skip
            except torch.OutOfMemoryError:
                if data.batch_size == 1 or self.networks[one.name].get("trained"):
                    raise
            data.batch_size //= 2
            self.say(f"{one.name}: the memory holds no larger batch than {data.batch_size}")

    def _export(self, one: Sized, curve: Exporter, module: LightningModule) -> None:
        """Export weights, checkpoint and tables; print how far the training is."""
        self.rows[one.name] = curve.rows
        experiment = one.network.experiment or one.name
        card = {"experiment": experiment, "overrides": self.plan.given(one.network)[1:]}
        with self.exporting:
            number = self.exports.weights(one.name, curve.export, card)
            if one.name in self.fit.checkpoints:
                path = curve.export.with_suffix(".ckpt")
                module.trainer.save_checkpoint(path)
                self.exports.checkpoint(one.name, path)
            splits = [each for each in module.trainer.callbacks if isinstance(each, SpeedSplit)]
            self.networks[one.name] |= {
                "hours": module.clock.hours,
                "steps": module.steps,
                "trained": module.global_step,
                "windows": module.windows_seen,
                "generation": number,
                "checkpoint": one.name in self.fit.checkpoints,
                "speed": splits[0].report if splits else {},
            }
            self._tables()
        self.say(
            f"{one.name}: {module.steps} steps, {module.windows_seen} windows, "
            f"{module.clock.hours * 60:.2f} min of training, generation {number}"
        )

    def _tables(self) -> None:
        """Export curves and profile."""
        rows = [{"network": name} | row for name, rows in self.rows.items() for row in rows]
        heads = list(dict.fromkeys(head for row in rows for head in row)) or ["network"]
        lines = [[row.get(head, "") for head in heads] for row in rows]
        texts = results.csv_text(heads, lines), json.dumps(self.profile, indent=1, default=str)
        for name, text in zip(TABLES, texts, strict=True):
            self.exports.text(name, text + "\n" * (name == TABLES[1]))

    def _undone(self, name: str, reason: str) -> None:
        """Note and say that a network was not trained to its end."""
        steps = self.networks[name].get("trained", 0)
        self.networks[name]["undone"] = reason
        self.say(f"{name} ended after {steps} steps: {reason}")

    def _exit_code(self) -> int:
        trained = [name for name, facts in self.networks.items() if facts.get("trained")]
        self.say(f"trained: {', '.join(trained) or 'nothing'}; in {self.exports.out}")
        return 0 if trained else 1

    def _watch(self) -> None:
        """End the process at the end of the lease, whatever holds it up then."""
        time.sleep(max(self.end - LAST_S - time.monotonic(), 0))
        self.exporting.acquire(timeout=LAST_S / 2)  # or an export is cut, as by a kill
        self.say("the lease is over and ends what still runs")
        code = self._exit_code()
        self.exports.close()
        sys.stdout.flush()
        os._exit(code)


def _in_one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:500]


def run(plan: Plan, fit: Fit, minutes: float, began: float, out: Path) -> int:
    """Train what `fit` has chosen, export to `out`; return the exit code of the process.

    Raises ValueError, before anything runs, where `out` holds files or the device is not there.
    """
    for chatty in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(chatty).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module=r"lightning\.pytorch")  # what it says of every run
    found = probe.device(fit.networks[0].cfg)
    check_memory(fit.networks, plan.fill.least, found)
    exports = Exports(out, int(plan.file_mib * MIB), fit.doubled)
    return Lease(plan, fit, minutes, began, exports, found).run()
