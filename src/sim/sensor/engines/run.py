"""Runs the sensor on the engine of the frames' device: numba's on the CPU, Triton's on CUDA."""

import warnings
from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

from src.sim.sensor.engines import sensor_cpu
from src.sim.sensor.engines.records import EngineInput, Grids

TRITON_FAILURES: list[str] = []  # why Triton's kernel does not run in this process


def voxels(given: EngineInput, grids: Grids) -> Grids:
    """Fill `grids`, contiguous zeros on the device of the frames, and return them.

    Raises ValueError for frames that are not finite or outside [0, 1].
    """
    if uses_triton(given):
        # Here, as Triton is not there everywhere.
        from src.sim.sensor.engines import sensor_triton

        try:
            return sensor_triton.voxels(given, grids)
        except (ValueError, torch.OutOfMemoryError):
            raise
        except Exception as error:  # no compiler, another driver: its errors are of many kinds
            TRITON_FAILURES.append(" ".join(f"{type(error).__name__}: {error}".split()))
            text = f"sensor: Triton fails, the CPU simulates from now on: {TRITON_FAILURES[-1]}"
            warnings.warn(text, stacklevel=2)
    if grids.device.type == "cpu":
        return sensor_cpu.voxels(given, grids)
    here = zeros(grids.shape, torch.device("cpu"))
    return grids.copy_(sensor_cpu.voxels(given, here))


def uses_triton(given: EngineInput) -> bool:
    """Return whether Triton's kernel runs: on CUDA, where it is installed, has not failed in this
    process and knows the time stamps.
    """
    possible = given.frames.is_cuda and not given.v2e_stamps and not TRITON_FAILURES
    return possible and find_spec("triton") is not None


def zeros(shape: Sequence[int], device: torch.device) -> Tensor:
    """Return float32 zeros, on the CPU in numpy's memory: in huge pages, and the system's own zeros
    until something else is written.
    """
    if device.type != "cpu":
        return torch.zeros(*shape, dtype=torch.float32, device=device)
    return torch.from_numpy(np.zeros(tuple(shape), np.float32))
