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

from src.app import build, hardware
from src.app.instantiate import build_part
from src.deploy.cpu_features import is_bf16_faster
from src.sim.pipeline import Sample

TRIAL_STEPS = 14  # the first ones make the CUDA graphs of those that follow
GIB, UNUSED_GIB = 2**30, 1.0  # of a device, which stay unused
MEMORY_FACTOR = 1.25  # times the memory of a trial that a training is left


@dataclass(frozen=True)
class Device:
    """The device of a lease: `kind` cuda or cpu, memory in bytes, whether bf16 and Triton work."""

    kind: str
    name: str
    memory: int
    bf16: bool
    triton: bool

    def describe(self) -> list[str]:
        """Return what there is, and what is done about what is missing, in lines."""
        versions = f"torch {torch.__version__}, lightning {lightning.__version__}"
        lines = [f"{self.name}, {self.memory / GIB:.0f} GiB, {versions}"]
        if not self.bf16:
            lines.append("bf16 is no faster here: trained in float32")
        if self.kind == "cuda" and not self.triton:
            lines.append("no Triton: the sensor is simulated by plain PyTorch")
        return lines


@dataclass(frozen=True)
class Trial:
    """The batch of a network, steps a second on made-up grids (None where there was no time for
    two), whether they ran as CUDA graphs, and the device's memory they took, in bytes."""

    batch: int
    steps_per_s: float | None = None
    cuda_graphs: bool = False
    memory: int = 0

    def __str__(self) -> str:
        speed = "not tried" if self.steps_per_s is None else f"{self.steps_per_s:.2f} steps/s"
        mode = "CUDA graphs" if self.cuda_graphs else "eager"
        return f"batch {self.batch}, {speed}, {mode}, {self.memory / GIB:.1f} GiB"


def probe_device(cfg: DictConfig) -> Device:
    """Return the device that `cfg` trains on; raises ValueError where there is none."""
    if cfg.trainer.accelerator == "cpu":
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        name = f"CPU, {torch.get_num_threads()} threads"
        return Device("cpu", name, memory, is_bf16_faster(), False)
    if not torch.cuda.is_available():
        raise ValueError(
            f"trainer must be cpu where there is no CUDA device (torch {torch.__version__}), "
            "as in conf/lease/dry.yaml"
        )
    torch.set_float32_matmul_precision("high")  # TF32 where float32 is left, as in convolutions
    bf16 = torch.cuda.get_device_capability() >= (8, 0)  # before, it is emulated
    memory = torch.cuda.get_device_properties(0).total_memory
    name, triton = torch.cuda.get_device_name(), find_spec("triton") is not None
    return Device("cuda", name, memory, bf16, triton)


def free_memory(kind: str) -> int:
    """Return the free bytes of the device."""
    gc.collect()  # trainings are cycles of objects, and hold memory until they are found
    if kind == "cuda":
        torch.cuda.empty_cache()
        return torch.cuda.mem_get_info()[0]
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_AVPHYS_PAGES")


def run_trial(cfg: DictConfig, device: Device, until: float, log: Callable[[str], None]) -> Trial:
    """Take some steps of the training `cfg` on made-up grids, until `until` (time.monotonic) at
    most; where its batch does not fit the memory, of half of it, which `cfg` then has.
    """
    while time.monotonic() <= until:
        if device.kind == "cuda":
            torch.cuda.reset_peak_memory_stats()
        try:
            return _time_steps(cfg, device.kind, until)
        except torch.OutOfMemoryError:
            halve_batch(cfg, device.name, log)
    return Trial(cfg.data.batch_size)


def halve_batch(cfg: DictConfig, device: str, log: Callable[[str], None]) -> None:
    """Halve the batch of `cfg`; ValueError where it is one clip."""
    if cfg.data.batch_size == 1:
        raise ValueError(f"{cfg.name} does not fit {device}, one clip at a time") from None
    cfg.data.batch_size //= 2
    log(f"{cfg.name}: the memory holds no larger batch than {cfg.data.batch_size}")


class StepTimer(Callback):
    """Notes when steps end; no more of them after `until`."""

    def __init__(self, until: float):
        self.until = until
        self.ends: list[float] = []

    def on_train_batch_end(self, trainer: lightning.Trainer, *_) -> None:
        """Note the time."""
        if torch.cuda.is_initialized():
            torch.cuda.synchronize()
        self.ends.append(time.perf_counter())
        trainer.should_stop |= time.monotonic() > self.until


def make_up_batch(cfg: DictConfig, device: str = "cpu") -> Sample:
    """Return a batch of random grids, a tenth of them not 0, and random frames."""
    n, windows = cfg.data.batch_size, cfg.data.windows
    side = cfg.data.crop if isinstance(cfg.data.crop, int) else max(cfg.data.crop)
    target = torch.rand(n, windows, 1, side, side, device=device)
    voxels = torch.randn(n, windows, cfg.optics.views, cfg.bins, side, side, device=device)
    voxels *= torch.rand_like(target[:, :, None]) < 0.1
    window_s = torch.full((n,), 1 / cfg.fps)
    return Sample(voxels, target, target, window_s, parameters=[{}] * n)


def train_on_batch(
    cfg: DictConfig, batch: Sample, callback: Callback, steps: int
) -> lightning.LightningModule:
    """Return the module of the training `cfg` after `steps` steps on one batch."""
    module = build.build_reconstructor(cfg, *build.build_untrained_network(cfg))
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = build_part(cfg, "trainer", callbacks=[callback], max_steps=steps, plugins=[], **quiet)
    trainer.fit(module, DataLoader([batch] * steps, collate_fn=lambda batches: batches[0]))
    return module


def _time_steps(cfg: DictConfig, kind: str, until: float) -> Trial:
    hardware.fill_in_precision(cfg)
    timer = StepTimer(until)
    module = train_on_batch(cfg, make_up_batch(cfg, kind), timer, TRIAL_STEPS)
    graphs = module.graphs is not None and bool(module.graphs.graphs)
    memory = torch.cuda.max_memory_allocated() if kind == "cuda" else 0
    spans = [end - start for start, end in pairwise(timer.ends)]
    return Trial(cfg.data.batch_size, 1 / min(spans) if spans else None, graphs, memory)
