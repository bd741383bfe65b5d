"""Light that flickers with the mains: an event camera sees it, the ground truth does not show it.

A lamp on alternating current is brightest twice a period: at 100 Hz where the mains have 50 Hz, at
120 Hz where they have 60 (IEEE 1789-2015, which also defines percent flicker, here `depth`).
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

MAINS = (50.0, 60.0)  # Hz
LEAST_RATE = 480.0  # frames/s: at fewer than four a period a flicker of 120 Hz aliases
POOL = (0.15, 0.6)  # frame widths, how far a lamp that lights a part of the scene reaches


def flicker(
    rng: np.random.Generator, times: NDArray, size: tuple[int, int], depths: Sequence[float]
) -> Float[Tensor, " frames #h #w"]:
    """Return the factor in (0, 1] that a lamp puts on the light at `times`, in seconds.

    It goes as |sin| at the mains' frequency, of random phase, with (highest - lowest) / (highest +
    lowest) drawn uniformly from `depths`; every second lamp lights the whole frame of `size`
    (h, w), the others a smooth pool of light.
    """
    mains, depth = MAINS[rng.integers(2)], rng.uniform(*depths)
    wave = abs(np.sin(2 * math.pi * mains * times + rng.uniform(0, math.pi)))
    swing = 2 * depth / (1 + depth)  # from the highest, which is 1
    whole, centre, reach = rng.uniform() < 0.5, rng.uniform(0, 1, 2), rng.uniform(*POOL)
    height, width = size
    across = np.arange(width) / width - centre[0]
    down = (np.arange(height) - centre[1] * height) / width
    pool = np.exp(-(across**2 + down[:, None] ** 2) / (2 * reach**2))
    lit = np.ones((1, 1)) if whole else pool
    return torch.from_numpy((1 - swing * lit * (1 - wave)[:, None, None]).astype(np.float32))
