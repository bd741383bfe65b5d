"""What an event sensor accepts, and the errors that say so."""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from src.sim.sensor.engines.job import DEFER, DELETE, HIGHEST, HOLD, LOWEST, State

MODES = {"defer": DEFER, "delete": DELETE, "hold": HOLD}
CHOICES = {
    "refractory": tuple(MODES),
    "stamps": ("linear", "v2e"),
    "input": ("linear", "srgb"),
    "response": ("log", "linlog"),
}
RANGES = {
    "refractory_s": (0, 10),
    "mismatch": (0, 1),
    "leak_hz": (0, 1e4),
    "shot_hz": (0, 1e6),
    "floor": (1e-3, 1),
    "off_ratio": (0.1, 10),
    "hot_fraction": (0, 1),
    "hot_hz": (0, 1e6),
    "cutoff_hz": (0, 1e6),
    "residual": (0, 1),
}
THRESHOLDS = (0.01, 5)
FIXED = ("floor",)  # part of the response: not drawn per clip


def threshold_range(threshold: float | Sequence[float]) -> tuple[float, float]:
    """Return (low, high) of `sensor.threshold`, a number or a range."""
    ends = (threshold, threshold) if isinstance(threshold, int | float) else tuple(threshold)
    if len(ends) != 2 or ends[0] > ends[1]:
        raise ValueError(f"sensor.threshold must be a number or [low, high], got {list(ends)}")
    for end in ends:
        within("sensor.threshold", end, *THRESHOLDS)
    return float(ends[0]), float(ends[1])


def check(settings: dict) -> None:
    """Raise ValueError for the first of a sensor's settings that is outside its range."""
    for name, allowed in CHOICES.items():
        if settings[name] not in allowed:
            raise ValueError(
                f"sensor.{name} must be one of {', '.join(allowed)}, got {settings[name]!r}"
            )
    for name, (low, high) in RANGES.items():
        within(f"sensor.{name}", settings[name], low, high)
    threshold_range(settings["threshold"])
    within("sensor.drawn_share", settings["drawn_share"], 0, 1)
    check_drawn(settings["drawn"])


def check_drawn(drawn: Mapping[str, Any]) -> None:
    """Raise ValueError unless `drawn` maps names of numbers of a sensor to ranges they can have."""
    allowed = {"threshold": THRESHOLDS} | RANGES
    for name, ends in drawn.items():
        if name not in allowed or name in FIXED:
            names = ", ".join(name for name in allowed if name not in FIXED)
            raise ValueError(f"sensor.drawn must hold ranges of {names}, got {name}")
        numbers = isinstance(ends, Sequence) and all(isinstance(end, int | float) for end in ends)
        if not numbers or len(ends) != 2 or not ends[0] <= ends[1]:
            raise ValueError(f"sensor.drawn.{name} must be [low, high], got {ends}")
        for end in ends:
            within(f"sensor.drawn.{name}", end, *allowed[name])


def within(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError for a value outside [low, high], or nan."""
    if not low <= value <= high:
        raise ValueError(f"{name} must be in [{low:g}, {high:g}], got {value}")


def check_frames(frames: Tensor, state: State | None) -> None:
    """Raise ValueError for the shape or type of frames, or a state, that sensors cannot take."""
    if frames.ndim != 5 or frames.dtype not in (torch.float16, torch.float32):
        raise ValueError(
            f"frames must be float32 or float16 (n, views, frames, h, w), got {frames.dtype} "
            f"{tuple(frames.shape)}"
        )
    n, v, count, h, w = frames.shape
    if min(n, v, h, w) < 1 or count < (2 if state is None else 1):
        raise ValueError(f"events need two frames of at least one pixel, got {tuple(frames.shape)}")
    if state is not None and state.level.shape != (n, v, h, w):
        raise ValueError(f"state is of {tuple(state.level.shape)}, frames are {(n, v, h, w)}")


def check_intensities(frames: Tensor) -> None:
    """Raise ValueError for frames that are not finite or outside [0, 1]."""
    low, high = (end.float() for end in torch.aminmax(frames))
    if not (low >= LOWEST and high <= HIGHEST):
        raise ValueError(f"frames must be finite and in [0, 1], got {low:g} to {high:g}")
