"""Runs a job on the engine of its device."""

import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from types import ModuleType

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.sensor.engines import sensor_cpu, sensor_eager
from src.sim.sensor.engines.job import Job

WITHOUT_TRITON: list[str] = []  # why Triton's kernel does not run here, once it has failed


def voxels(
    job: Job, grids: Float[Tensor, "n windows views bins h w"]
) -> Float[Tensor, "n windows views bins h w"]:
    """Fill `grids`, contiguous zeros, and return them; `job.state` moves on.

    Raises ValueError for frames that are not finite or outside [0, 1]; the state is then lost.
    """
    chosen = engine(job)
    try:
        chosen.voxels(job, grids)
    except (ValueError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # no compiler, another driver: Triton's errors are of many kinds
        if chosen in (sensor_cpu, sensor_eager):
            raise
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        warnings.warn(f"sensor: Triton fails, plain PyTorch from now on: {reason}", stacklevel=2)
        WITHOUT_TRITON.append(reason)
        sensor_eager.voxels(job, grids.zero_())
    job.state.frame += job.intervals
    return grids


def engine(job: Job) -> ModuleType:
    """Return the engine: numba's on the CPU, on CUDA Triton's where it is installed, has not failed
    in this process and knows the stamps, else plain torch.
    """
    if job.frames.device.type == "cpu":
        return sensor_cpu
    if job.frames.is_cuda and not job.v2e and not WITHOUT_TRITON and find_spec("triton"):
        # Here, as Triton is not there everywhere.
        from src.sim.sensor.engines import sensor_triton

        return sensor_triton
    return sensor_eager


def zeros(shape: Sequence[int], device: torch.device) -> Tensor:
    """Return float32 zeros, on the CPU in numpy's memory: in huge pages, and the system's own zeros
    until something else is written.
    """
    if device.type != "cpu":
        return torch.zeros(shape, device=device)
    return torch.from_numpy(np.zeros(shape, np.float32))
