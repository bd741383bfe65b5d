"""What tests of caches have drawn by other processes, which need not load the tests for it."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import torch

from src.sim.optics import Optics
from src.sim.pipeline import Pipeline
from src.sim.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.training.disk_cache import CacheFillerProcess, DiskClipCache
from src.training.parallel_fill import fill
from tests.sim.test_pipeline import Waves

MIXED = SimulatedTurbulence({"severity": "mixed"}, temporal_model="mixed")


def source(scene=None, turbulence=MIXED) -> Pipeline:
    return Pipeline(
        scene or Waves(frames=7, side=40), Optics(9), turbulence, EventSensor(), split="train",
        crop=24, random_crop=True,
    )  # fmt: skip


class Slow(Waves):
    """Waves that take their time."""

    def __init__(self):
        super().__init__(frames=7, side=40)

    def clip(self, index: int):
        time.sleep(0.2)
        return super().clip(index)


class Telling(Waves):
    """Waves that write to the file `told` how the process that draws them sees CUDA."""

    def __init__(self, told: Path):
        super().__init__(frames=7, side=40)
        self.told = told

    def clip(self, index: int):
        seen = os.environ["CUDA_VISIBLE_DEVICES"]
        self.told.write_text(f"{torch.cuda.is_initialized()} {seen!r}")
        return super().clip(index)


class Growing(Waves):
    """Waves whose frames are larger from clip to clip."""

    def clip(self, index: int):
        self.side = 40 + 4 * index
        return super().clip(index)


class Broken(Waves):
    """Waves of which clip 2 is refused or kills the process that draws it."""

    def __init__(self, killed: bool):
        super().__init__(frames=7, side=40)
        self.killed = killed

    def clip(self, index: int):
        if index == 2 and self.killed:
            os.kill(os.getpid(), signal.SIGKILL)
        if index == 2:
            raise ValueError("scene.root must hold readable photographs, got two.png")
        return super().clip(index)


class Other(SimulatedTurbulence):
    """Air that knows the contract of contract.py and no more; that of clip 2 cannot be computed."""

    def operator(self, drawn, **size):
        return OtherAir(super().operator(drawn, **size))


class OtherAir:
    def __init__(self, air):
        self.air, self.metadata = air, air.metadata

    def degrade(self, frames, generator, *, crop=None):
        if torch.equal(frames[0], Waves(frames=7, side=40).clip(2).frames):
            raise MemoryError("no room")
        return self.air.degrade(frames, generator, crop=crop)

    def tilt(self, frames, generator, *, crop=None):
        return self.air.tilt(frames, generator, crop=crop)


def fill_for_ever(told: str) -> None:
    """Fill; the processes' numbers are in the file `told` once they draw."""

    def store(*_) -> None:
        pids = [str(process.pid) for process in multiprocessing.active_children()]
        part = Path(told + ".part")  # renamed, so that nobody reads half of it
        part.write_text(" ".join(pids))
        part.rename(told)

    fill(source(), range(10**6), store, device="cpu", workers=2)


def start_filler(cache: DiskClipCache, told: Path) -> None:
    """Start a filler, as a training does, and hang; the filler's number is in the file `told`."""
    filler = CacheFillerProcess(cache)
    filler.start()
    told.write_text(str(filler.process.pid))
    time.sleep(600)
