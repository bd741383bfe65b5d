"""Which engine warps and scatters many pictures on a device."""

import warnings
from functools import cache
from importlib.util import find_spec
from types import ModuleType

import torch

from src.sim.turbulence.engines import blur_eager
from src.sim.turbulence.engines.device import full_float32
from src.sim.turbulence.lattice import Lattice

PITCHES = 1, 3  # a kernel each
AGREED = 1e-3  # of white


@cache
def on(device: torch.device) -> ModuleType:
    """Return Triton's kernels on CUDA where they are installed and do what plain torch does, a few
    seconds to find out, else plain torch.
    """
    if device.type != "cuda" or not find_spec("triton"):
        return blur_eager
    try:
        from src.sim.turbulence.engines import blur_triton  # here, as Triton is not everywhere

        apart = [difference(blur_triton, pitch, device) for pitch in PITCHES]
        if all(part < AGREED for part in apart):  # a NaN is no agreement
            return blur_triton
        reason = f"they differ by {max(apart):.2g}"
    except Exception as error:  # whatever a compiler or a driver raises
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"turbulence without Triton's kernels, slower: {reason}", stacklevel=2)
    return blur_eager


def difference(other: ModuleType, pitch: int, device: torch.device) -> float:
    """Return how much pictures of another engine differ from those of plain torch, at most."""
    generator, rows = torch.Generator().manual_seed(pitch), Lattice(-3, 40, pitch, 1)
    frames, halo = (torch.rand(2, *size, generator=generator) for size in ((30, 90), (34, 71)))
    tilt = 3 * torch.randn(2, 5, 40, 77, generator=generator)
    psfs = torch.rand(49, 5, rows.nodes, 77, generator=generator) - 0.3
    given = [part.to(device) for part in (frames, halo, tilt, psfs)]
    frames, halo, tilt, psfs = given
    warped, made = [], []
    for engine in (other, blur_eager):
        with full_float32():
            warped.append(engine.warp(frames, tilt, -3, 2, 1))
            made.append(engine.scatter(warped[-1], psfs, rows, halo, 0.1, 1))
    return max(float((one - two).abs().max()) for one, two in (warped, made))
