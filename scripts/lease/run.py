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
from scripts.lease.fill import fill_caches
from scripts.lease.plan import MIB, Plan
from scripts.lease.selection import Selection, SizedNetwork, allot_seconds, overhead_s
from scripts.lease.training import ExportingCurve, train_network
from src.metrics.table import NAMES
from src.records import results
from src.training.clip_cache import DeviceClipCache

SHUTDOWN_S = 3.0  # before the end of a lease, when whatever still runs is ended


class Lease:
    """The `selection` of `plan` on `device`, from `start` (time.monotonic) on for `minutes`."""

    def __init__(
        self,
        plan: Plan,
        selection: Selection,
        minutes: float,
        start: float,
        exports: Exports,
        device: probe.Device,
    ):
        self.plan, self.selection, self.exports, self.device = plan, selection, exports, device
        self.start, self.end = start, start + 60 * minutes
        self.networks: dict[str, dict] = {one.name: {} for one in selection.networks}
        self.profile: dict[str, Any] = {
            "commit": results.git_commit(), "minutes": minutes, "left_out": selection.left_out,
            "device": vars(device), "check": {}, "caches": [], "networks": self.networks,
        }  # fmt: skip
        self.rows: dict[str, list[dict]] = {}
        self.trials: dict[str, probe.Trial] = {}
        self.filled: list[DeviceClipCache] = []
        self.stop_reason = ""
        self.exporting = threading.Lock()

    def run(self) -> int:
        """Do it all; return the exit code: 0 where all networks that are not optional were trained
        to their end."""
        threading.Thread(target=self._end_in_time, daemon=True).start()
        for name, reason in self.selection.left_out.items():
            self.log(f"{name} is left out: {reason}")
        self._run_trials()
        for place, one in enumerate(self.selection.networks):
            if self.stop_reason:
                self._note_unfinished(one.name, self.stop_reason)
                continue
            try:
                self._fill_and_train(one, self.selection.networks[place:])
            except (KeyboardInterrupt, SystemExit, SIGTERMException):
                self.stop_reason = "the lease was stopped"
                self._note_unfinished(one.name, self.stop_reason)
            except Exception as error:  # whatever becomes of one, the others are trained
                traceback.print_exc()
                self._note_unfinished(one.name, _in_one_line(error))
        for cache in self.filled:
            cache.clear()  # ends those who draw
        self._export_tables()
        self.exports.close()
        return self._exit_code()

    def log(self, text: str) -> None:
        """Print a line with the second of the lease."""
        print(f"[{time.monotonic() - self.start:4.0f} s] {text}", flush=True)

    def _run_trials(self) -> None:
        """Print what the device is and how fast each network trains; fall back where it has to."""
        until = time.monotonic() + self.plan.check_s
        for line in self.device.describe():
            self.log(line)
        for one in self.selection.networks:
            if not self.device.bf16:
                one.cfg.trainer.precision = "32-true"
            try:
                trial = probe.run_trial(one.cfg, self.device, until, self.log)
            except Exception as error:  # the training may work all the same, or says it again
                traceback.print_exc()
                self.log(f"{one.name}: the trial failed: {_in_one_line(error)}")
                trial = probe.Trial(one.cfg.data.batch_size)
            self.trials[one.name] = trial
            self.profile["check"][one.name] = vars(trial)
            self.log(f"{one.name}: {one.params:,} parameters, {trial}")

    def _fill_and_train(self, one: SizedNetwork, rest: list[SizedNetwork]) -> None:
        """Fill the cache of a network, where it is another, and train it."""
        if one.caches and one.caches != self.filled:
            for cache in self.filled:
                cache.clear()
            self.filled, trial = [], self.trials[one.name]
            reports = fill_caches(one.caches, self.plan.fill, self.device, trial, self.log)
            self.profile["caches"] += reports
            self.filled = one.caches
        probe.free_memory(self.device.kind)  # what the network before held
        now, minutes = time.monotonic(), one.network.minutes
        fixed = overhead_s(self.plan, rest) - self.plan.check_s
        fixed -= self.plan.margin_s / 2  # of the beginning
        fixed -= 60 * self.plan.fill.minutes * bool(one.caches)
        seconds = allot_seconds([other.network for other in rest], self.end - now - fixed)[0]
        if seconds < (30 * minutes if one.network.optional else 1):
            raise ValueError(f"{seconds:.0f} s are left for its {minutes:g} minutes")
        self.log(f"{one.name} trains for {seconds / 60:.2f} minutes")
        self._train(one, now + seconds)
        row = self.rows[one.name][-1]
        scores = ", ".join(f"{name} {row[name]:.4g}" for name in NAMES if name in row)
        self.networks[one.name]["finished"] = True
        self.log(f"{one.name} is trained: {scores}")

    def _train(self, one: SizedNetwork, until: float) -> None:
        """Train a network until `until`, then score it; with half the batch where the trial had no
        time to find out that it does not fit the memory.
        """

        def publish(curve: ExportingCurve, module: LightningModule) -> None:
            self._export(one, curve, module)

        deadline = until + self.plan.validate.total_s
        while True:
            times = {"seconds": until - time.monotonic(), "deadline": deadline}
            try:
                folder = self.exports.partial_folder
                return train_network(self.plan, one, **times, folder=folder, publish=publish)
            except torch.OutOfMemoryError:
                if self.networks[one.name].get("trained"):
                    raise
                probe.halve_batch(one.cfg, self.device.name, self.log)

    def _export(self, one: SizedNetwork, curve: ExportingCurve, module: LightningModule) -> None:
        """Export weights, checkpoint and tables; print how far the training is."""
        assert curve.export is not None
        self.rows[one.name] = curve.rows
        experiment = one.network.experiment or one.name
        card = {"experiment": experiment, "overrides": self.plan.overrides(one.network)[1:]}
        with self.exporting:
            generation = self.exports.export_weights(one.name, curve.export, card)
            self.networks[one.name] |= {
                "hours": module.clock.hours,
                "steps": module.steps_so_far,
                "trained": module.global_step,
                "windows": module.windows_seen,
                "generation": generation,
                "cuda_graphs": len(module.graphs.graphs) if module.graphs else 0,
            }
            self._export_tables()
        self.log(
            f"{one.name}: {module.steps_so_far} steps, {module.windows_seen} windows, "
            f"{module.clock.hours * 60:.2f} min of training, generation {generation}"
        )

    def _export_tables(self) -> None:
        rows = [{"network": name} | row for name, rows in self.rows.items() for row in rows]
        heads = list(dict.fromkeys(head for row in rows for head in row)) or ["network"]
        curves = results.format_csv(heads, [[row.get(head, "") for head in heads] for row in rows])
        profile = json.dumps(self.profile, indent=1, default=str) + "\n"
        for name, text in zip(TABLES, (curves, profile), strict=True):
            self.exports.export_text(name, text)

    def _note_unfinished(self, name: str, reason: str) -> None:
        steps = self.networks[name].get("trained", 0)
        self.networks[name]["unfinished"] = reason
        self.log(f"{name} ended after {steps} steps: {reason}")

    def _exit_code(self) -> int:
        trained = [name for name, facts in self.networks.items() if facts.get("trained")]
        required = [one.name for one in self.selection.networks if not one.network.optional]
        missing = [name for name in required if not self.networks[name].get("finished")]
        unfinished = f"; unfinished: {', '.join(missing)}" if missing else ""
        self.log(f"trained: {', '.join(trained) or 'nothing'}{unfinished}; in {self.exports.out}")
        return 1 if missing or not trained else 0

    def _end_in_time(self) -> None:
        """End the process at the end of the lease, whatever holds it up then."""
        time.sleep(max(self.end - SHUTDOWN_S - time.monotonic(), 0))
        self.exporting.acquire(timeout=SHUTDOWN_S / 2)  # or an export is cut, as by a kill
        self.log("the lease is over and ends what still runs")
        code = self._exit_code()
        self.exports.close()
        sys.stdout.flush()
        os._exit(code)


def _in_one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:500]


def run_lease(plan: Plan, selection: Selection, minutes: float, start: float, out: Path) -> int:
    """Train the `selection`, export to `out`; return the exit code of the process.

    Raises ValueError, before anything runs, where `out` holds files or there is no such device.
    """
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module=r"lightning\.pytorch")  # what it says of every run
    device = probe.probe_device(selection.networks[0].cfg)
    file_bytes, total_bytes = (
        int(mib * MIB) for mib in (plan.max_export_file_mib, plan.max_export_total_mib)
    )
    exports = Exports(out, file_bytes, total_bytes, plan.max_export_files)
    return Lease(plan, selection, minutes, start, exports, device).run()
