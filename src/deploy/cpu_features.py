"""What this processor computes fast in."""

from functools import cache, partial

import torch
from torch.nn import functional

from src.deploy.cost import time_calls

TIMED_CONVOLUTIONS = 20  # of each type, the first of which are slow


@cache
def is_bf16_faster() -> bool:
    """Return whether this processor is faster in bf16 than in float32, by a convolution in each.

    Without instructions for it bf16 takes many times longer.  With them it takes half the time or,
    on Intel's processors whose matrix unit (AMX) a virtual machine hides, twice as long.
    """
    has = _has_any("avx512_bf16", "amx_bf16", "bf16")
    return has and time_convolution_s(torch.bfloat16) < time_convolution_s(torch.float32)


def has_int8_dot_product() -> bool:
    """Return whether this processor has instructions that multiply bytes and add them up."""
    return _has_any("avx512_vnni", "avx_vnni")


def _has_any(*names: str) -> bool:
    capabilities = torch.cpu.get_capabilities()
    return any(capabilities.get(name) for name in names)


def time_convolution_s(dtype: torch.dtype) -> float:
    """Return the seconds of a convolution of 85 MMAC, channels last, the shortest of some: on one
    thread, as what another job computes on a second core would decide which type is faster.
    """
    maps = torch.ones(1, 64, 48, 48, dtype=dtype).to(memory_format=torch.channels_last)
    kernel = torch.ones(64, 64, 3, 3, dtype=dtype).to(memory_format=torch.channels_last)
    convolve = partial(functional.conv2d, maps, kernel, padding=1)
    return time_calls(convolve, seconds=0, min_calls=TIMED_CONVOLUTIONS).least_ms / 1e3
