"""Paths, arrays and times that a user's own code gives: one line for what cannot be read."""

import os
from pathlib import Path
from typing import Any

import numpy as np

LEAST_TIME_STEPS = 1000  # of the type of times in a window


def read_path(name: str, value: Any) -> Path:
    """Return the path `value`; ValueError, beginning with `name`, for what is none."""
    if not isinstance(value, str | os.PathLike):
        raise ValueError(f"{name} must be a path, got a {type(value).__name__}")
    return Path(value)


def read_array(name: str, values: Any) -> np.ndarray:
    """Return `values`, an array, a list or a tensor, as an array.

    Raises ValueError, beginning with `name`, for a masked array and for what NumPy does not read,
    such as a tensor that is on a GPU, in bf16 or requires grad.
    """
    if isinstance(values, np.ma.MaskedArray):
        raise ValueError(f"{name} must be without a mask, got a masked array")
    try:
        return np.asarray(values)
    except (RuntimeError, TypeError, ValueError) as error:
        why = " ".join(str(error).split())
        raise ValueError(f"{name} must be an array that NumPy reads: {why}") from error


def is_number(value: Any) -> bool:
    """Return whether `value` is one real number, of Python, NumPy or PyTorch."""
    try:
        array = np.asarray(value)
    except (RuntimeError, TypeError, ValueError):  # a tensor on a GPU, in bf16, or with a gradient
        return False
    return array.ndim == 0 and array.dtype.kind in "iuf"


def describe_coarse_times(t: np.ndarray, window: float, unit: str = "") -> str:
    """Return that the type of `t` has fewer than LEAST_TIME_STEPS in a `window`, for a warning; ""
    where it has not.  `unit`: of both, as it stands behind a number."""
    if not len(t) or t.dtype.kind != "f" or t.dtype.itemsize >= 8:
        return ""
    latest = np.abs(t).max()
    step = float(np.spacing(latest))
    if step * LEAST_TIME_STEPS <= window:
        return ""
    return f"t is {t.dtype}, in steps of {step:g}{unit} at {latest:g}{unit}: float64 resolves it"
