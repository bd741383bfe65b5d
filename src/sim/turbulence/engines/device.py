"""How a device computes turbulence: which engine, how exactly, and how numbers get there."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from types import ModuleType

import torch
from torch import Tensor

from src.sim.turbulence.coefficient_grid import GridAxis
from src.sim.turbulence.engines import blur_torch

TESTED_PITCHES = 1, 3  # a kernel each
LARGEST_DIFFERENCE = 1e-3  # of white


@contextmanager
def full_float32() -> Iterator[None]:
    """Multiply matrices in float32 proper: TF32 and autocast would cost a phase three digits."""
    products = torch.backends.cuda.matmul
    before, products.allow_tf32 = products.allow_tf32, False
    try:
        with torch.autocast("cuda", enabled=False):
            yield
    finally:
        products.allow_tf32 = before


def copy_to_device(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor on a device; the CPU goes on while it is copied there."""
    if device.type == "cuda" and tensor.device.type == "cpu":
        tensor = tensor.pin_memory()
    return tensor.to(device, non_blocking=True)


@cache
def select_blur_engine(device: torch.device) -> ModuleType:
    """Return Triton's kernels on CUDA where they do what plain torch does, else plain torch."""
    if device.type != "cuda" or not find_spec("triton"):
        return blur_torch
    try:
        from src.sim.turbulence.engines import blur_triton  # here, as Triton is not everywhere

        apart = [max_difference_from_torch(blur_triton, pitch, device) for pitch in TESTED_PITCHES]
        if all(part < LARGEST_DIFFERENCE for part in apart):  # a NaN is no agreement
            return blur_triton
        reason = f"they differ by {max(apart):.2g}"
    except Exception as error:  # whatever a compiler or a driver raises
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"turbulence without Triton's kernels, slower: {reason}", stacklevel=2)
    return blur_torch


def max_difference_from_torch(engine: ModuleType, pitch: int, device: torch.device) -> float:
    """Return how much pictures of another engine differ from those of plain torch, at most."""
    generator, rows = torch.Generator().manual_seed(pitch), GridAxis(-3, 40, pitch, 1)
    frames, halo = (torch.rand(2, *size, generator=generator) for size in ((30, 90), (34, 71)))
    tilt = 3 * torch.randn(2, 5, 40, 77, generator=generator)
    psfs = torch.rand(49, 5, rows.node_count, 77, generator=generator) - 0.3
    frames, halo, tilt, psfs = (part.to(device) for part in (frames, halo, tilt, psfs))
    warped, made = [], []
    for one in (engine, blur_torch):
        with full_float32():
            warped.append(one.warp_cubic(frames, tilt, -3, 2, 1))
            made.append(one.scatter_normalised(warped[-1], psfs, rows, halo, 0.1, 1))
    return max(float((a - b).abs().max()) for a, b in (warped, made))
