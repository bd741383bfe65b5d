"""From intensity to log intensity in fixed point, by one table.

A level is an int32 multiple of 2**-20 nat.  The table is read at the upper 18 bits of the float32
intensity (1024 nodes per octave, as floats are laid out) and interpolated linearly with integers,
so that every processor makes the same level of the same intensity.  The error against the exact
curve is below one unit; only where the lin-log curve has its kink it reaches 4e-4 nat.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

UNIT = 2**20  # levels per nat
OCTAVES = 14  # intensities below 2**-14 count as 2**-14
NODES = 1024  # per octave
FIRST = (127 - OCTAVES) << 23  # the bits of 2**-14
LAST = (128 << 23) - 1  # the bits of the largest float below 2
CELL = 13  # bits of a float within one cell of the table
EXTRA = 4  # the table keeps levels to 2**-24 nat
LINLOG_KNEE = 20 / 255  # v2e: linear below code value 20 (Hu et al. 2021)


def decode_srgb(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return linear light of sRGB code values in [0, 1] (IEC 61966-2-1)."""
    curve = ((values.clamp(min=0) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, curve)


def encode_srgb(light: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the sRGB code values of linear light: the inverse of `decode_srgb`."""
    curve = 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, curve)


def response_table(response: str, source: str, floor: float) -> Int[Tensor, "nodes"]:
    """Return log intensity at the table's nodes, int32 multiples of 2**-24 nat.

    `response` is `log`, the logarithm of max(intensity, floor), or `linlog`, v2e's: a line through
    zero below code value 20, the logarithm of the code value above.  `source` says what the
    intensities are: `linear`, taken as they are, or `srgb`, decoded to linear light first.
    """
    x = nodes(source)
    if response == "log":
        y = np.log(np.maximum(x, floor))
    else:
        slope = math.log(20.0) / 20.0
        y = np.where(x <= LINLOG_KNEE, 255.0 * x * slope, np.log(255.0 * x))
    return torch.from_numpy(np.rint(y * UNIT * 2**EXTRA).astype(np.int32))


def nodes(source: str) -> np.ndarray:
    """Return the light at the table's nodes, 2**-14 to 2 of what `source` says, float64."""
    bits = FIRST + (np.arange((OCTAVES + 1) * NODES + 1, dtype=np.int64) << CELL)
    x = bits.astype(np.int32).view(np.float32).astype(np.float64)
    return decode_srgb(torch.from_numpy(x)).numpy() if source == "srgb" else x


def lookup(
    table: Int[Tensor, "nodes"], intensity: Float[Tensor, "*shape"], shift: int = EXTRA
) -> Int[Tensor, "*shape"]:
    """Return the table's value at float32 intensities, int32, rounded by `shift` bits."""
    place = intensity.contiguous().view(torch.int32).clamp(FIRST, LAST) - FIRST
    cell, inside = place >> CELL, place & (2**CELL - 1)
    left = table[cell]
    value = left + (((table[cell + 1] - left) * inside) >> CELL)
    return (value + (1 << (shift - 1))) >> shift
