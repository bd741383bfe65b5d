"""From intensity to log intensity in fixed point, by one table.

A level is an int32 multiple of 2**-20 nat.  The table is read at the upper 18 bits of the float32
intensity (1024 nodes per octave, as floats are laid out) and interpolated linearly with integers,
so that every processor makes the same level of the same intensity.  The error is below one unit,
4e-4 nat at the kink of the lin-log curve.
"""

import math
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

UNIT = 2**20  # levels per nat
OCTAVES = 14  # intensities below 2**-14 count as 2**-14
NODES = 1024  # per octave
FIRST = (127 - OCTAVES) << 23  # the bits of 2**-14
CELL = 13  # bits of a float within one cell of the table
EXTRA = 4  # the table keeps levels to 2**-24 nat
CPU = torch.device("cpu")
LINLOG_KNEE = 20 / 255  # v2e: linear below code value 20 (Hu et al. 2021)


def decode_srgb(values: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return linear light of sRGB code values in [0, 1] (IEC 61966-2-1)."""
    curve = ((values.clamp(min=0) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, curve)


def encode_srgb(light: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Return the sRGB code values of linear light: the inverse of `decode_srgb`."""
    curve = 1.055 * light.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(light <= 0.0031308, 12.92 * light, curve)


@lru_cache(maxsize=16)
def response_table(
    response: str, source: str, floor: float, device: torch.device = CPU
) -> Int[Tensor, " nodes"]:
    """Return log intensity at the table's nodes, int32 multiples of 2**-24 nat; read it only.

    `response` is `log`, the logarithm of max(intensity, floor), or `linlog`, v2e's: a line through
    zero below code value 20, the logarithm of the code value above.  `source` says what the
    intensities are: `linear`, taken as they are, or `srgb`, decoded to linear light first.
    """
    x, slope = table_nodes(source), math.log(20.0) / 20.0
    linlog = np.where(x <= LINLOG_KNEE, 255.0 * x * slope, np.log(255.0 * x))
    y = linlog if response == "linlog" else np.log(np.maximum(x, floor))
    return torch.from_numpy(_scaled(y)).to(device)


@lru_cache(maxsize=16)
def low_pass_table(cutoff_hz: float, fps: float, encoding: str) -> NDArray[np.int32]:
    """Return decay and lag of a photoreceptor at the table's nodes, (2, nodes) in 2**-24.

    The photoreceptor is one pole whose corner frequency is proportional to intensity (v2e). For
    a level that moves linearly by D in an interval dt and a/tau = 2 pi f dt the exact solution
    is y1 + (filtered0 - y0) exp(-a) - D (1 - exp(-a)) / a, whatever the interval.
    """
    a = 2 * math.pi * cutoff_hz / fps * (255 * table_nodes(encoding) + 20) / 275
    return _scaled(np.stack([np.exp(-a), -np.expm1(-a) / a]))


def _scaled(curves: NDArray[np.float64]) -> NDArray[np.int32]:
    return np.rint(curves * UNIT * 2**EXTRA).astype(np.int32)


def table_nodes(source: str) -> np.ndarray:
    """Return the light at the table's nodes, 2**-14 to 2 of what `source` says, float64."""
    bits = FIRST + (np.arange((OCTAVES + 1) * NODES + 1, dtype=np.int64) << CELL)
    x = bits.astype(np.int32).view(np.float32).astype(np.float64)
    return decode_srgb(torch.from_numpy(x)).numpy() if source == "srgb" else x
