"""Counter-based random numbers: a number is a function of (key, counter) and of nothing else.

A key is built from words such as (seed, split, clip, view, stage); a counter numbers the element
(pixel, frame, wave ...).  No state is kept, so a crop, another batch order, another number of
workers or another device draws the same numbers: integers bit for bit, floats to rounding.

The mixing function is the two-multiply 32-bit finaliser `lowbias32` (C. Wellons, 2018), applied to
the low and the high half of the counter in turn, each time under half of the 64-bit key.
"""

import hashlib
import math
from typing import TypeVar

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

MASK = 0xFFFFFFFF
T = TypeVar("T", int, Tensor)


def key(*words: int | np.integer | str) -> int:
    """Return the 63-bit key of `words`, whole numbers of any type alike; stable across processes,
    machines and Python versions.
    """
    plain = (int(word) if isinstance(word, np.integer) else word for word in words)
    text = "\x1f".join(f"{type(word).__name__}:{word}" for word in plain)
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "big") >> 1


def generator(key: int) -> torch.Generator:
    """Return a CPU generator seeded with `key`, for drawing the parameters of a sample."""
    return torch.Generator().manual_seed(key)


def draw_base_key(generator: torch.Generator) -> int:
    """Draw one 62-bit number from `generator`, to derive the keys of views and stages from."""
    return int(torch.randint(2**62, (), generator=generator))


def bits(key: int | Int[Tensor, "..."], counters: Int[Tensor, "..."]) -> Int[Tensor, "..."]:
    """Return 32 random bits per counter as int64 in [0, 2**32); `counters` are in [0, 2**63).

    Keys that are a tensor are broadcast with the counters.
    """
    low, high = key & MASK, (key >> 32) & MASK
    mixed = _mixed((counters & MASK) ^ low)
    return _mixed((mixed + (counters >> 32) * 0x9E3779B9 + high) & MASK)


def uniform(key: int | Int[Tensor, "..."], counters: Int[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Return float32 uniforms in the open interval (0, 1), from the upper 23 bits."""
    return ((bits(key, counters) >> 9).to(torch.float32) + 0.5) * 2.0**-23


def uniforms(key: int, count: int) -> list[float]:
    """Return `uniform(key, torch.arange(count))` as numbers: a hundredth of the time for a few."""
    low, high = key & MASK, (key >> 32) & MASK
    drawn = (_mixed(_mixed(counter ^ low) + high & MASK) for counter in range(count))
    return [((word >> 9) + 0.5) * 2.0**-23 for word in drawn]


def normal(key: int, counters: Int[Tensor, "..."]) -> Float[Tensor, "..."]:
    """Return float32 standard normals (Box-Muller on counters 2k and 2k + 1)."""
    radius = torch.sqrt(-2.0 * torch.log(uniform(key, 2 * counters)))
    return radius * torch.cos(2.0 * math.pi * uniform(key, 2 * counters + 1))


def _mixed(x: T) -> T:
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & MASK
    x = x ^ (x >> 15)
    x = (x * 0x846CA68B) & MASK
    return x ^ (x >> 16)
