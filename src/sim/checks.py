"""Checks of the values of a config."""

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any


def check_in_range(key: str, value: Any, low: float, high: float) -> None:
    """Raise ValueError for a value of `key` that is no number in [low, high]."""
    is_number = isinstance(value, Real)
    if not (is_number and low <= value <= high):
        bounds = f">= {low:.5g}" if high == math.inf else f"in [{low:.5g}, {high:.5g}]"
        raise ValueError(f"{key} must be {bounds}, got {value}")


def is_range(ends: Any) -> bool:
    """Return whether `ends` are two numbers [low, high]."""
    numbers = isinstance(ends, Sequence) and all(isinstance(end, int | float) for end in ends)
    return numbers and len(ends) == 2 and ends[0] <= ends[1]
