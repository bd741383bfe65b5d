"""What a time-limited training finds out about its device first, and falls back to."""

import gc
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import pairwise

import lightning
import torch
from lightning import Callback
from omegaconf import DictConfig
from torch.utils.data import DataLoader

from src.app import build
from src.app.parts import part
from src.sim.pipeline import Sample
from src.training.step_time import matrix_peak, now

TRIED = 14  # steps of a trial: the first ones make the CUDA graphs of those that follow
GIB, EMPTY_GIB = 2**30, 1.0  # of a device, which stay empty
ROOM = 1.25  # times the memory of a trial that a training is left


@dataclass(frozen=True)
class Device:
    """The device of a lease: `kind` cuda or cpu, memory in bytes, the measured peak of a matrix
    product in operations a second, and whether bf16 and Triton are there.
    """

    kind: str
    name: str
    memory: int
    peak: float
    bf16: bool
    triton: bool

    def lines(self) -> list[str]:
        """Return what is there, and what is done about what is not."""
        kind = "bf16" if self.bf16 else "float32"
        lines = [
            f"{self.name}, {self.memory / GIB:.0f} GiB, torch {torch.__version__}, lightning "
            f"{lightning.__version__}; {kind} matrix peak {self.peak / 1e12:.3g} TFLOP/s"
        ]
        if not self.bf16:
            lines.append("bf16 is no faster here: trained in float32")
        if self.kind == "cuda" and not self.triton:
            lines.append("no Triton: the sensor is simulated by plain PyTorch")
        return lines


@dataclass(frozen=True)
class Trial:
    """The batch of a network, steps a second on made-up grids, None where there was no time for
    two, how a step ran (CUDA graphs or eager) and the device's memory it took, in bytes."""

    batch: int
    steps_per_s: float | None = None
    step: str = "eager"
    memory: int = 0


def device(cfg: DictConfig) -> Device:
    """Return the device that `cfg` trains on; raises ValueError where it is not there."""
    if cfg.trainer.accelerator == "cpu":
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        name = f"CPU, {torch.get_num_threads()} threads"
        half = build.computes_bf16()
        peak = matrix_peak(torch.device("cpu"), "bf16" if half else "32")
        return Device("cpu", name, memory, peak, half, False)
    if not torch.cuda.is_available():
        raise ValueError(
            f"trainer must be cpu where there is no CUDA device (torch {torch.__version__}), "
            "as in conf/lease/dry.yaml"
        )
    torch.set_float32_matmul_precision("high")  # TF32 where float32 is left, as in convolutions
    half = torch.cuda.get_device_capability() >= (8, 0)  # before, bf16 is emulated
    peak = matrix_peak(torch.device("cuda"), "bf16" if half else "32")
    memory = torch.cuda.get_device_properties(0).total_memory
    name, triton = torch.cuda.get_device_name(), find_spec("triton") is not None
    return Device("cuda", name, memory, peak, half, triton)


def free_memory(kind: str) -> int:
    """Return the bytes of the device that nobody holds."""
    gc.collect()  # trainings are cycles of objects, and hold memory until they are found
    if kind == "cuda":
        torch.cuda.empty_cache()
        return torch.cuda.mem_get_info()[0]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")


def try_steps(cfg: DictConfig, found: Device, until: float, say: Callable[[str], None]) -> Trial:
    """Take some steps of the training `cfg` on made-up grids, until `until` (time.monotonic) at
    most; where its batch does not fit the memory, of half of it, which `cfg` then has.
    """
    while True:
        if time.monotonic() > until:
            return Trial(cfg.data.batch_size)
        if found.kind == "cuda":
            torch.cuda.reset_peak_memory_stats()
        try:
            ends, step = _steps(cfg, found, until)
        except torch.OutOfMemoryError:
            if cfg.data.batch_size == 1:
                raise ValueError(
                    f"{cfg.name} does not fit {found.name}, one clip at a time"
                ) from None
            cfg.data.batch_size //= 2
            say(f"{cfg.name}: the memory holds no larger batch than {cfg.data.batch_size}")
            continue
        memory = torch.cuda.max_memory_allocated() if found.kind == "cuda" else 0
        spans = [b - a for a, b in pairwise(ends)]
        return Trial(cfg.data.batch_size, 1 / min(spans) if spans else None, step, memory)


class Ends(Callback):
    """Notes when steps end; no more of them after `until`."""

    def __init__(self, until: float):
        self.until = until
        self.ends: list[float] = []

    def on_train_batch_end(self, trainer: lightning.Trainer, *_) -> None:
        """Note the time."""
        self.ends.append(now())
        trainer.should_stop |= time.monotonic() > self.until


def _steps(cfg: DictConfig, found: Device, until: float) -> tuple[list[float], str]:
    """Return when each of some steps ended, and how they ran."""
    build.choose_precision(cfg)
    module = build.reconstructor(cfg, *build.network(cfg))
    n, windows = cfg.data.batch_size, cfg.data.windows
    side = cfg.data.crop if isinstance(cfg.data.crop, int) else max(cfg.data.crop)
    target = torch.rand(n, windows, 1, side, side, device=found.kind)
    shape = (n, windows, cfg.optics.views, cfg.bins, side, side)
    voxels = torch.randn(shape, device=found.kind)
    voxels *= torch.rand_like(target[:, :, None]) < 0.1
    known = {"drawn": [{}] * n, "window_s": torch.full((n,), 1 / cfg.fps)}
    sample, ends = Sample(voxels, target, target, **known), Ends(until)
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = part(cfg, "trainer", callbacks=[ends], **quiet | {"max_steps": TRIED, "plugins": []})
    trainer.fit(module, DataLoader([sample] * TRIED, collate_fn=lambda batch: batch[0]))
    graphs = module.graphs is not None and bool(module.graphs.graphs)
    return ends.ends, "CUDA graphs" if graphs else "eager"
