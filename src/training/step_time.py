"""Where the time of a training step goes, and what share of the device's arithmetic it uses."""

import time
from typing import Any

import torch
from lightning import Callback
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils.flop_counter import flop_registry

MATRIX_SIDE = {"cpu": 1024, "cuda": 8192}
KINDS = {"bf16": torch.bfloat16, "16-m": torch.float16}  # how a precision's name begins


class StageClock:
    """Adds up `seconds` by stage, from `start` or the mark before to each `mark`.

    Off, it costs nothing.  On, it waits for a GPU at every mark, so that a stage is charged with
    what it launched: for a few steps only.
    """

    def __init__(self):
        self.on, self.last = False, 0.0
        self.seconds: dict[str, float] = {}

    def start(self) -> None:
        """Begin to count here."""
        if self.on:
            self.last = now()

    def mark(self, stage: str) -> None:
        """Charge `stage` with the time since the mark before."""
        if self.on:
            before, self.last = self.last, now()
            self.seconds[stage] = self.seconds.get(stage, 0.0) + self.last - before


class Arithmetic(TorchDispatchMode):
    """Counts the `flops` of the convolutions and matrix products that run inside it."""

    def __init__(self):
        super().__init__()
        self.flops = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None) -> Any:
        """Run an operator and add what it costs."""
        out = func(*args, **(kwargs or {}))
        cost = flop_registry.get(func._overloadpacket)
        if cost is not None:
            self.flops += cost(*args, **(kwargs or {}), out_val=out)
        return out


class SpeedSplit(Callback):
    """Print once, after `after` steps, and at the end: samples trained on a second, the share of
    each stage, and the model FLOP utilisation, which is the convolutions and matrix products of a
    step over the device's peak, measured with matrices in the same precision (Chowdhery et al.
    2022).  `report` has the numbers.

    The first half of the steps warms up and is not counted.  With workers simulation and training
    overlap, so that shares are those of the work, not of the wall time.
    """

    def __init__(self, after: int = 20):
        self.after, self.seen = after, 0
        self.simulated, self.trained, self.started = 0.0, 0.0, 0.0
        self.clips, self.pixels, self.flops = 0, 0, 0.0  # of steps that count; FLOPs of a pixel
        self.counter: Arithmetic | None = None
        self.report: dict[str, Any] = {}

    def on_train_batch_start(self, trainer, module, batch, batch_idx: int) -> None:
        """Note the time the training step begins; count the arithmetic of the first."""
        module.stages.on = self.after // 2 <= self.seen < self.after
        if self.seen == 0:
            self.counter = Arithmetic()
            self.counter.__enter__()
        self.started = now()

    def on_train_batch_end(self, trainer, module, outputs, batch, batch_idx: int) -> None:
        """Add up; print when enough steps are seen."""
        taken, pixels = now() - self.started, _pixels(batch)
        if self._close():
            self.flops = self.counter.flops / pixels
        self.seen += 1
        if self.after // 2 < self.seen <= self.after:
            self.simulated += batch.seconds
            self.trained += taken
            self.clips, self.pixels = self.clips + len(batch.voxels), self.pixels + pixels
        if self.seen == self.after:
            module.stages.on = False
            self.report = self._measured(trainer, module)
            trainer.print(self.text())

    def on_train_end(self, trainer, module) -> None:
        """Print the line again, where it is found."""
        if self.report:
            trainer.print(self.text())

    def on_exception(self, trainer, module, exception: BaseException) -> None:
        """Count no further."""
        self._close()

    def _close(self) -> bool:
        """End the counting of arithmetic; return whether there was any."""
        counts = self.seen == 0 and self.counter is not None
        if counts:
            self.counter.__exit__(None, None, None)
        return counts

    def _measured(self, trainer, module) -> dict[str, Any]:
        steps = self.after - self.after // 2
        whole = self.simulated + self.trained
        stages = {name: spent / whole for name, spent in module.stages.seconds.items()}
        peak = matrix_peak(module.device, str(trainer.precision))
        return {
            "samples_per_s": self.clips / whole,
            "simulation_s": self.simulated / steps,
            "training_s": self.trained / steps,
            "shares": {"simulation": self.simulated / whole} | stages,
            "flop_utilisation": self.flops * self.pixels / self.trained / peak,
            "peak_tflops": peak / 1e12,
            "tflop_per_step": self.flops * self.pixels / steps / 1e12,
        }

    def text(self) -> str:
        """Return the line that is printed."""
        report = self.report
        shares = ", ".join(f"{name} {share:.0%}" for name, share in report["shares"].items())
        return (
            f"per step: simulation {report['simulation_s']:.3f} s, "
            f"training {report['training_s']:.3f} s; {report['samples_per_s']:.2f} samples/s; "
            f"{shares}; model FLOP utilisation {report['flop_utilisation']:.1%} of "
            f"{report['peak_tflops']:.3g} TFLOP/s"
        )


def now() -> float:
    """Return the time in seconds once all that a GPU was given is done."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def matrix_peak(device: torch.device, precision: str, trials: int = 5) -> float:
    """Return the FLOPs a second of a product of square matrices, the best of `trials`."""
    kinds = [kind for name, kind in KINDS.items() if precision.startswith(name)]
    side = MATRIX_SIDE.get(device.type, MATRIX_SIDE["cpu"])
    matrix = torch.rand(side, side, dtype=kinds[0] if kinds else torch.float32, device=device)
    least = float("inf")
    for _ in range(trials):
        start = now()
        matrix @ matrix
        least = min(least, now() - start)
    return 2 * side**3 / least


def _pixels(batch) -> int:
    n, windows, *_, height, width = batch.voxels.shape
    return n * windows * height * width
