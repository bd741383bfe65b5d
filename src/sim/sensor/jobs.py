"""From the sensors and frames of n clips to what an engine is given."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.sensor.engines import job
from src.sim.sensor.engines.job import CLIP, Job, State, blank
from src.sim.sensor.limits import MODES, THRESHOLDS, check_frames, threshold_range, within
from src.sim.sensor.response import UNIT, low_pass_table, response_table

if TYPE_CHECKING:
    from src.sim.sensor.sensor import EventSensor

SHY = 2  # thresholds are lowered by so many units: a change of n C makes n events, rounded or not
ALIKE = ("refractory", "stamps", "input", "response", "floor")  # settings of all sensors of a job


def kind(sensor: "EventSensor") -> tuple:
    """Return what must be the same of all sensors of a job."""
    return *(getattr(sensor, name) for name in ALIKE), sensor.cutoff_hz > 0


def make_job(
    sensors: "Sequence[EventSensor]",
    frames: Tensor,
    fps: Sequence[float],
    state: State | None = None,
    *,
    substeps: int = 1,
    clips: Sequence[int],
    views: Sequence[int],
    origins: Sequence[tuple[int, int]],
    full_widths: Sequence[int],
    thresholds: Sequence[float] | None = None,
) -> Job:
    """Return the job of `sensors`, one of each clip and all of one kind, from `state` on.

    `frames` (n, views, frames, h, w); the rest is as in `batch.voxels`.
    """
    check_frames(frames, state)
    per_clip = {"fps": fps, "clips": clips, "origins": origins, "full_widths": full_widths}
    thresholds = list(map(_threshold, sensors)) if thresholds is None else thresholds
    check_numbers(frames, views, sensors=sensors, thresholds=thresholds, **per_clip)
    for rate in fps:
        within("fps", rate, 1e-3, 1e6)
    n, v, count, h, w = frames.shape
    sensor, device = sensors[0], frames.device
    edges = _edges(fps, 0 if state is None else state.frame, count + (state is not None))
    if (edges.shape[1] - 1) % substeps:
        raise ValueError(f"{edges.shape[1] - 1} intervals are not whole windows of {substeps}")
    rows, low_pass = _low_pass(sensors, fps)
    numbers = zip(sensors, fps, thresholds, origins, full_widths, rows, strict=True)
    return Job(
        frames=frames,
        fresh=state is None,
        level=response_table(sensor.response, sensor.input, sensor.floor, device),
        low_pass=torch.from_numpy(low_pass).to(device),
        state=blank((n, v, h, w), device) if state is None else state,
        edges=edges,
        substeps=substeps,
        mode=MODES[sensor.refractory],
        v2e=sensor.stamps == "v2e",
        clips=np.array([_clip(*parts) for parts in numbers], CLIP),
        keys=_keys(sensors, clips, views),
    )


def check_numbers(frames: Tensor, views: Sequence[int], **per_clip: Sequence) -> None:
    """Raise ValueError unless `views` has one id per view and all the rest one entry per clip."""
    n, v = frames.shape[:2]
    wanted = dict.fromkeys(per_clip, n) | {"views": v}
    for name, values in (per_clip | {"views": views}).items():
        if len(values) != wanted[name]:
            raise ValueError(
                f"frames of {n} clips and {v} views need {wanted[name]} {name}, got {len(values)}"
            )


def whole_windows(frames: Tensor, substeps: int) -> Tensor:
    """Return the frames (n, views, frames, h, w) without those after the last whole window."""
    usable = (frames.shape[2] - 1) // substeps * substeps + 1
    if usable < 2:
        raise ValueError(f"events need at least {substeps + 1} frames, got {frames.shape[2]}")
    return frames[:, :, :usable]


def _threshold(sensor: "EventSensor") -> float:
    low, high = threshold_range(sensor.threshold)
    if low < high:
        raise ValueError(
            f"sensor.threshold is the range {low} to {high}: draw one per clip, "
            "sample_threshold, and give it as `threshold`"
        )
    return low


def _clip(sensor, fps, threshold, origin, full_width, low_pass) -> tuple:
    """Return a clip's numbers, in the order of CLIP."""
    within("sensor.threshold", threshold, *THRESHOLDS)
    for name in ("shot_hz", "hot_hz"):
        within(f"sensor.{name}", getattr(sensor, name), 0, fps)
    return (
        math.floor(threshold * UNIT) - SHY,
        math.floor(threshold * sensor.off_ratio * UNIT) - SHY,
        round(sensor.mismatch * UNIT),
        round(sensor.hot_fraction * 2**32),
        round(sensor.leak_hz / fps * 2**24),
        round(sensor.shot_hz / fps * 2**32),
        round(sensor.hot_hz / fps * 2**32),
        *origin,
        full_width,
        low_pass,
        np.float32(sensor.refractory_s * fps),
        sensor.residual,
    )


def _keys(sensors, clips, views) -> NDArray[np.int64]:
    """Return the keys of all views of all clips; see Job.

    What a pixel is goes with sensor and view, what happens to it with the clip as well.
    """
    keys = np.zeros((len(sensors), len(views), job.KEYS), np.int64)
    for (sensor, clip), own in zip(zip(sensors, clips, strict=True), keys, strict=True):
        for view, drawn in zip(views, own, strict=True):
            if sensor.mismatch:
                drawn[job.MISMATCH_KEY] = noise.key(sensor.seed, view, "mismatch")
            if sensor.hot_fraction:
                drawn[job.HOT_KEY] = noise.key(sensor.seed, view, "hot")
            if sensor.shot_hz or sensor.hot_hz or sensor.residual:
                drawn[job.SHOT_KEY] = noise.key(sensor.seed, clip, view, "shot")
                drawn[job.RESIDUAL_KEY] = noise.key(int(drawn[job.SHOT_KEY]), "residual")
    return keys


def _low_pass(sensors, fps) -> tuple[list[int], NDArray[np.int32]]:
    """Return which row of the tables is each clip's, and the tables; see Job."""
    source, cutoffs = sensors[0].input, [sensor.cutoff_hz for sensor in sensors]
    if not cutoffs[0]:
        return [0] * len(sensors), np.empty((0, 2, 1), np.int32)
    pairs = list(zip(cutoffs, fps, strict=True))
    distinct = list(dict.fromkeys(pairs))
    tables = [low_pass_table(*pair, source) for pair in distinct]
    return [distinct.index(pair) for pair in pairs], np.stack(tables)


def _edges(fps: Sequence[float], first: int, count: int) -> NDArray[np.int64]:
    """Return ceil(k 10^6 / fps) for `count` frames from `first` on; strictly increasing."""
    microseconds = 1e6 / np.array(fps, np.float64)[:, None]
    return np.ceil(np.arange(first, first + count) * microseconds - 1e-6).astype(np.int64)
