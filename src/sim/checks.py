"""Checks of the values of a config."""

import math
from collections.abc import Sequence
from typing import Any


def check_in_range(key: str, value: float, low: float, high: float) -> None:
    """Raise ValueError for a value of `key` outside [low, high], or nan."""
    if not low <= value <= high:
        bounds = f">= {low:.3g}" if high == math.inf else f"in [{low:.3g}, {high:.3g}]"
        raise ValueError(f"{key} must be {bounds}, got {value}")


def is_range(ends: Any) -> bool:
    """Return whether `ends` are two numbers [low, high]."""
    numbers = isinstance(ends, Sequence) and all(isinstance(end, int | float) for end in ends)
    return numbers and len(ends) == 2 and ends[0] <= ends[1]
