"""From the sensors and frames of n clips to what an engine is given, and what a sensor accepts."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.checks import check_in_range, is_range, is_real
from src.sim.sensor.engines import records
from src.sim.sensor.engines.records import CLIP, EngineInput
from src.sim.sensor.response import UNIT, low_pass_table, response_table

ALLOWANCE = 2  # units off a threshold: a change of n C makes n events, rounded or not
COMMON = ("refractory", "stamps", "input", "response", "floor")  # of all sensors of an EngineInput
MODES = {"defer": records.DEFER, "delete": records.DELETE, "hold": records.HOLD}
CHOICES = {
    "refractory": tuple(MODES),
    "stamps": ("linear", "v2e"),
    "input": ("linear", "srgb"),
    "response": ("log", "linlog"),
}
RANDOM_RANGES = {  # of the numbers that may be drawn per clip
    "threshold": (0.01, 5),
    "refractory_s": (0, 10),
    "mismatch": (0, 1),
    "leak_event_hz": (0, 1e4),
    "dark_noise_hz": (0, 1e6),
    "off_ratio": (0.1, 10),
    "hot_pixel_fraction": (0, 1),
    "hot_pixel_hz": (0, 1e6),
    "cutoff_hz": (0, 1e6),
    "initial_reference_error": (0, 1),
}
NOISE_RATES = ("dark_noise_hz", "hot_pixel_hz", "leak_event_hz")  # at most one event a frame
FIXED_RANGES = {"floor": (1e-3, 1), "random_share": (0, 1)}


class SensorClip(NamedTuple):
    """A clip's sensor (of the contract), frames a second, the key of its noise, and its crop's
    (top, left) in frames of `full_width`.
    """

    sensor: Any
    fps: float
    key: int
    origin: tuple[int, int]
    full_width: int


def build_engine_input(
    clips: Sequence[SensorClip], frames: Tensor, views: Sequence[int], *, substeps: int = 1
) -> EngineInput:
    """Return the input of `clips`, whose sensors agree in COMMON and all have a low-pass or none;
    `frames`: (n, views, frames, h, w), `views`: ids.

    Frames after the last whole window of `substeps` intervals are left out.  Raises ValueError for
    frames of another shape or type, too few of them, and numbers outside their range.
    """
    check_frames(frames, len(clips), len(views), substeps)
    count = (frames.shape[2] - 1) // substeps * substeps + 1
    sensor, device = clips[0].sensor, frames.device
    for clip in clips:
        check_in_range("fps", clip.fps, 1e-3, 1e6)
    low_passes = [(clip.sensor.cutoff_hz, clip.fps) for clip in clips if clip.sensor.cutoff_hz]
    rows = list(dict.fromkeys(low_passes))
    tables = [low_pass_table(*row, sensor.input) for row in rows]
    low_pass_rows = map(rows.index, low_passes) if rows else [0] * len(clips)
    numbers = [_clip_numbers(clip, row) for clip, row in zip(clips, low_pass_rows, strict=True)]
    interval_us = 1e6 / np.array([clip.fps for clip in clips], np.float64)[:, None]
    return EngineInput(
        frames=frames[:, :, :count],
        level_table=response_table(sensor.response, sensor.input, sensor.floor, device),
        low_pass_tables=torch.from_numpy(
            np.stack(tables) if tables else np.empty((0, 2, 1), np.int32)
        ).to(device),
        edges_us=np.ceil(np.arange(count) * interval_us - 1e-6).astype(np.int64),
        width=frames.shape[4],
        substeps=substeps,
        refractory_mode=MODES[sensor.refractory],
        v2e_stamps=sensor.stamps == "v2e",
        clips=np.array(numbers, CLIP),
        keys=_noise_keys(clips, views),
    )


def _clip_numbers(clip: SensorClip, low_pass_row: int) -> tuple:
    sensor, fps = clip.sensor, clip.fps
    low, high = threshold_range(sensor.threshold)
    if low < high:
        got = f"the range {low} to {high}"
        raise ValueError(f"sensor.threshold is {got}: `draw` the sensor of each clip first")
    threshold = float(np.float32(low))
    for name in NOISE_RATES:
        check_in_range(f"sensor.{name}", getattr(sensor, name), 0, fps)
    return (
        math.floor(threshold * UNIT) - ALLOWANCE,
        math.floor(threshold * sensor.off_ratio * UNIT) - ALLOWANCE,
        round(sensor.mismatch * UNIT),
        round(sensor.hot_pixel_fraction * 2**32),
        round(sensor.leak_event_hz / fps * 2**24),
        round(sensor.dark_noise_hz / fps * 2**32),
        round(sensor.hot_pixel_hz / fps * 2**32),
        *clip.origin,
        clip.full_width,
        low_pass_row,
        np.float32(sensor.refractory_s * fps),
        *_reference_range(sensor),
    )


def _reference_range(sensor: Any) -> tuple[float, float]:
    """Return the zero and the span of a sensor's first references; see records.py.

    With leak they lie anywhere on the way to the next ON event, so that these come from the first
    moment on, and not all at once: at their rate, with an initial error e at 1 / (1 + e) of it
    until the drift has passed a threshold.  From then on, while the light rests, an error between 0
    and 1 leaves 2 / (1 + e) of the rate for a share e of the way to each event, else 1 / (1 + e).
    """
    error = sensor.initial_reference_error
    return (error / (1 + error), 1 + error) if sensor.leak_event_hz else (0.5, 2 * error)


def _noise_keys(clips: Sequence[SensorClip], views: Sequence[int]) -> NDArray[np.int64]:
    """Return the keys of all views of all clips; see EngineInput.

    What a pixel is goes with sensor and view, what happens to it with the clip as well.
    """
    keys = np.zeros((len(clips), len(views), records.KEYS), np.int64)
    for (sensor, _, clip_key, *_), own in zip(clips, keys, strict=True):
        for view, drawn in zip(views, own, strict=True):
            if sensor.mismatch:
                drawn[records.MISMATCH_KEY] = noise.key(sensor.seed, view, "mismatch")
            if sensor.hot_pixel_fraction:
                drawn[records.HOT_PIXEL_KEY] = noise.key(sensor.seed, view, "hot")
            if any(getattr(sensor, name) for name in (*NOISE_RATES, "initial_reference_error")):
                key = noise.key(sensor.seed, clip_key, view, "shot")
                drawn[records.NOISE_KEY] = key
                drawn[records.REFERENCE_KEY] = noise.key(key, "residual")
    return keys


def threshold_range(threshold: Any) -> tuple[float, float]:
    """Return (low, high) of `sensor.threshold`, a number or a range."""
    if not (is_real(threshold) or is_range(threshold)):
        allowed = "a number or [low, high], low <= high"
        raise ValueError(f"sensor.threshold must be {allowed}, got {threshold}")
    ends = [threshold, threshold] if is_real(threshold) else threshold
    for end in ends:
        check_in_range("sensor.threshold", end, *RANDOM_RANGES["threshold"])
    return float(ends[0]), float(ends[1])


def check_settings(settings: Mapping[str, Any]) -> None:
    """Raise ValueError for the first of a sensor's settings that is outside its range."""
    for name, allowed in CHOICES.items():
        if settings[name] not in allowed:
            wanted = f"one of {', '.join(allowed)}"
            raise ValueError(f"sensor.{name} must be {wanted}, got {settings[name]!r}")
    for name, limits in (RANDOM_RANGES | FIXED_RANGES).items():
        if name != "threshold":
            check_in_range(f"sensor.{name}", settings[name], *limits)
    threshold_range(settings["threshold"])
    for name, ends in settings["random"].items():
        if name not in RANDOM_RANGES:
            names = ", ".join(RANDOM_RANGES)
            raise ValueError(f"sensor.random must hold ranges of {names}, got {name}")
        if not is_range(ends):
            raise ValueError(f"sensor.random.{name} must be [low, high], low <= high, got {ends}")
        for end in ends:
            check_in_range(f"sensor.random.{name}", end, *RANDOM_RANGES[name])


def check_frames(frames: Tensor, clips: int, views: int, substeps: int) -> None:
    """Raise ValueError for a shape or type of frames that the sensors of so many clips cannot take,
    or fewer than a window of them.
    """
    shape = tuple(frames.shape)
    if frames.ndim != 5 or frames.dtype not in (torch.float16, torch.float32):
        wanted = "float32 or float16 (n, views, frames, h, w)"
        raise ValueError(f"frames must be {wanted}, got {frames.dtype} {shape}")
    if shape[:2] != (clips, views):
        raise ValueError(f"frames must be of {clips} clips and {views} views, got {shape}")
    if min(shape) < 1:
        raise ValueError(f"events need frames of at least one pixel, got {shape}")
    if shape[2] <= substeps:
        raise ValueError(f"events need at least {substeps + 1} frames, got {shape[2]}")
