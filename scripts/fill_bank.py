"""Fill a bank of air before the trainings that use it, with the config they will have:

    python -m scripts.fill_bank experiment=lf3x3 data.bank=1500 scene.root=... [+workers=2]

That of data.large is filled first.  `+device=cuda` simulates on a GPU.  Stopped anywhere and
started again it goes on; several may fill one bank, trainings may use it.
"""

import multiprocessing
import os
import time

import hydra
import torch
from omegaconf import DictConfig

from src.app import door, simulation
from src.training.bank import Bank
from src.training.bank_filler import fill

EVERY = 10.0  # seconds between two lines


def fill_bank(bank: Bank, workers: int, device: str = "cpu") -> None:
    """Fill with so many processes on `device`; raises OSError where clips could not be kept."""
    print(bank.status(), flush=True)
    start, before = time.monotonic(), len(bank.missing())
    spawn = multiprocessing.get_context("spawn")
    running = [
        spawn.Process(target=_work, args=(bank, os.getpid(), device), daemon=True)
        for _ in range(workers)
    ]
    for process in running:
        process.start()
    while alive := [process for process in running if process.is_alive()]:
        alive[0].join(EVERY)
        left, spent = len(bank.missing()), time.monotonic() - start
        each = spent / max(before - left, 1)
        print(f"{bank.clips - left} of {bank.clips} clips, {each:.2f} s each", flush=True)
    if bank.missing():
        raise OSError(f"{len(bank.missing())} clips are missing in {bank.folder}")


def _work(bank: Bank, parent: int, device: str) -> None:
    torch.set_num_threads(1)
    fill(bank, lambda: os.getppid() == parent, device)


@hydra.main(version_base=None, config_path="../conf", config_name="train")
def main(cfg: DictConfig) -> None:
    """Glue between Hydra and `fill_bank`."""
    workers = cfg.get("workers", 1)
    if type(workers) is not int or workers < 1:
        raise ValueError(f"workers must be a whole number >= 1, got {workers}")
    device = cfg.get("device", "cpu")
    if device not in ("cpu", "cuda"):
        raise ValueError(f"device must be cpu or cuda, got {device}")
    if device == "cuda" and not torch.cuda.is_available():
        raise ValueError("device must be cpu where there is no CUDA device, got cuda")
    large = simulation.large_stream(cfg)
    if large is not None:
        fill_bank(large.pipeline.bank, workers, device)
    fill_bank(simulation.bank(cfg), workers, device)


if __name__ == "__main__":
    door.run(main)
