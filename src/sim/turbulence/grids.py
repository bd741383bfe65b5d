"""The tables of what each simplification of the blur costs, kept beside the networks.

Measured on exact PSFs by scripts/p2s_errors.py, over D/r0 and lambda / D in pixels.
"""

import math
from functools import cache

from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor

from src.sim.turbulence.p2s import FILE


def at(name: str, strength: float, airy: float) -> Float[Tensor, "*axis"]:
    """Interpolate a table (strength, ..., airy) in the logarithm of both."""
    rows = between(table(name), table("strength"), strength)
    return between(rows.movedim(-1, 0), table("airy"), airy)


def between(rows: Tensor, axis: Tensor, value: float) -> Tensor:
    """Interpolate the `rows` at the values `axis` in the logarithm; held beyond its ends."""
    place = max(value, float(axis[0]))
    high = int((axis < place).sum().clamp(1, len(axis) - 1))
    low = high - 1
    share = math.log(place / float(axis[low])) / math.log(float(axis[high] / axis[low]))
    return rows[low] + (rows[high] - rows[low]) * min(share, 1.0)


@cache
def _tables() -> dict[str, Tensor]:
    return load_file(FILE)


def table(name: str) -> Tensor:
    """Return the table or axis of that name."""
    return _tables()[f"errors.{name}"]
