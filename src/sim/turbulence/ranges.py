"""Draws from ranges and severities, and what is said where they are none."""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float

MIX = {"weak": 0.1, "medium": 0.3, "strong": 0.6}  # of the paper's data set
Range = Sequence[float]
Draws = Float[np.ndarray, " candidates"]


def log_between(u: Draws | float, limits: Range, name: str) -> Draws | float:
    """Return log-uniform numbers in `limits` from uniform ones in [0, 1]; ValueError likewise."""
    if not limits[0] > 0:
        raise refused(name, "a range above 0", list(limits))
    return np.exp(between(u, [math.log(limit) for limit in limits], name))


def between(u: Draws | float, limits: Range, name: str) -> Draws | float:
    """Return uniform numbers in `limits` from those in [0, 1]; ValueError for no range."""
    low, high = limits
    if not -math.inf < low <= high < math.inf:
        raise refused(name, "a range low <= high", list(limits))
    return low + (high - low) * u


def choose_severity(severity: str, generator: torch.Generator) -> str:
    """Return `severity`, of `mixed` one drawn by MIX; ValueError for another word."""
    if severity in MIX:
        return severity
    if severity != "mixed":
        raise refused("severity", ", ".join(["none", *MIX, "mixed"]), severity)
    u = float(torch.rand((), generator=generator, dtype=torch.float64))
    return "weak" if u < MIX["weak"] else "medium" if u < 1 - MIX["strong"] else "strong"


def require(valid: bool, name: str, allowed: str, value: object) -> None:
    """Raise ValueError, naming `turbulence.name`, unless `valid`."""
    if not valid:
        raise ValueError(f"turbulence.{name} must be {allowed}, got {value}")


def refused(name: str, allowed: str, value: object) -> ValueError:
    """Return the error for a value of `turbulence.atmosphere`."""
    return ValueError(f"turbulence.atmosphere.{name} must be {allowed}, got {value}")
