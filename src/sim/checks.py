"""Checks of the values of a config."""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np


def is_real(value: Any) -> bool:
    """Return whether `value` is a real number of Python or NumPy, no bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_in_range(key: str, value: Any, low: float, high: float) -> None:
    """Raise ValueError for a value of `key` that is no number in [low, high]."""
    if not (is_real(value) and low <= value <= high):
        bounds = f">= {low:.5g}" if high == math.inf else f"in [{low:.5g}, {high:.5g}]"
        raise ValueError(f"{key} must be {bounds}, got {value}")


def is_range(ends: Any) -> bool:
    """Return whether `ends` are two numbers [low, high], a sequence or an array."""
    is_pair = isinstance(ends, Sequence | np.ndarray) and len(ends) == 2
    return is_pair and all(map(is_real, ends)) and bool(ends[0] <= ends[1])
