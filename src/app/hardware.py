"""Threads, freed memory, precision and CUDA graphs, chosen for the machine that a run is on."""

import ctypes
import os

import torch
from lightning.pytorch.accelerators import CUDAAccelerator
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from omegaconf import DictConfig

from src.app.instantiate import as_dict
from src.deploy.cpu_features import is_bf16_faster

TRIM_THRESHOLD, MMAP_MAX = -1, -4  # of mallopt, in malloc.h


def reserve_worker_cores(cfg: DictConfig) -> None:
    """On a CPU leave one core to each of `data.workers`; a smaller OMP_NUM_THREADS stands."""
    if cfg.trainer.accelerator == "cpu":
        available = (os.cpu_count() or 1) - cfg.data.workers
        torch.set_num_threads(max(1, min(torch.get_num_threads(), available)))


def retain_freed_memory(cfg: DictConfig) -> None:
    """Make glibc keep what a training on a CPU frees: asking the system for it again in every step
    takes an eighth of the time.
    """
    library = ctypes.CDLL(None)
    if cfg.trainer.accelerator == "cpu" and hasattr(library, "mallopt"):
        library.mallopt(MMAP_MAX, 0)
        library.mallopt(TRIM_THRESHOLD, -1)  # never


def fill_in_precision(cfg: DictConfig) -> None:
    """Set a `trainer.precision` of null to bf16-mixed, on a CPU without fast bf16 to 32-true.

    Raises ValueError for float16, whose scaled gradients StepGuard would take for the real ones.
    """
    if str(cfg.trainer.precision).startswith("16"):
        allowed = "bf16-mixed, 32-true or null"
        raise ValueError(f"trainer.precision must be {allowed}, got {cfg.trainer.precision}")
    if cfg.trainer.precision is None:
        fast_bf16 = cfg.trainer.accelerator != "cpu" or is_bf16_faster()
        cfg.trainer.precision = "bf16-mixed" if fast_bf16 else "32-true"


def uses_cuda_graphs(cfg: DictConfig) -> bool:
    """Return whether a step runs as CUDA graphs; raises ValueError where it should and cannot."""
    if cfg.cuda_graphs not in ("auto", True, False):
        raise ValueError(f"cuda_graphs must be one of auto, true, false, got {cfg.cuda_graphs}")
    possible = cfg.trainer.accelerator != "cpu" and torch.cuda.is_available()
    possible = possible and len(requested_gpus(cfg)) == cfg.trainer.get("num_nodes", 1) == 1
    possible &= not cfg.get("source")
    if cfg.cuda_graphs is True and not possible:
        where = "without a GPU, on several and for a post-processor"
        raise ValueError(f"cuda_graphs must be auto or false {where}, got true")
    return bool(cfg.cuda_graphs) and possible


def requested_gpus(cfg: DictConfig) -> list[int]:
    """Return the numbers of the GPUs that `trainer.devices` asks for: so many, a list or all.

    Raises ValueError for what is none of these, and for a GPU that is not there.
    """
    devices = as_dict(cfg.trainer)["devices"]
    try:
        return CUDAAccelerator.parse_devices(-1 if devices == "auto" else devices) or []
    except (TypeError, ValueError, MisconfigurationException) as error:
        wanted = "a number of devices, a list of their numbers or auto"
        why = " ".join(str(error).split())
        raise ValueError(f"trainer.devices must be {wanted}, got {devices}: {why}") from error


def first_requested_gpu(cfg: DictConfig) -> int:
    """Return the number of the first GPU that `trainer.devices` asks for, on which tests run."""
    return next(iter(requested_gpus(cfg)), 0)
