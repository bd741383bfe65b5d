"""Clips of different sensors through their sensors in one call."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.sensor.contract import Sensor
from src.sim.sensor.engines import run
from src.sim.sensor.jobs import check_numbers, kind, make_job, whole_windows
from src.sim.sensor.sensor import EventSensor


def voxels(
    sensors: Sequence[Sensor],
    frames: Float[Tensor, "n views frames h w"],
    fps: Sequence[float],
    bins: int = 5,
    *,
    substeps: int = 1,
    clips: Sequence[int],
    views: Sequence[int],
    origins: Sequence[tuple[int, int]],
    full_widths: Sequence[int],
    thresholds: Sequence[float] | None = None,
    out: Float[Tensor, "n windows views bins h w"] | None = None,
) -> Float[Tensor, "n windows views bins h w"]:
    """Return the grids of n clips, contiguous and on the frames' device: in `out`, if given,
    which must hold zeros.

    Equal bit for bit to `sensors[i].voxels` of each clip; `frames` (float32, or float16 which is
    widened as it is read) may lie in memory in any order.  Per clip: `fps`, the key of its noise in
    `clips`, its crop's (top, left) in `origins` in frames of `full_widths`, an ON threshold instead
    of its sensor's in `thresholds`.  `EventSensor`s of one kind (`jobs.kind`) go through their
    engine together, a sensor of another class by itself.  Raises ValueError as
    `EventSensor.voxels` does, or where the numbers of things do not agree.
    """
    frames = whole_windows(frames, substeps)
    n, v, count, h, w = frames.shape
    per_clip = {"fps": fps, "clips": clips, "origins": origins, "full_widths": full_widths}
    per_clip |= {} if thresholds is None else {"thresholds": thresholds}
    check_numbers(frames, views, sensors=sensors, **per_clip)
    shape = (n, (count - 1) // substeps, v, bins, h, w)
    out = run.zeros(shape, frames.device) if out is None else _fitting(out, shape, frames.device)
    groups = _groups(sensors)
    if len(groups) == 1:
        return _fill(out, sensors, frames, substeps, views, per_clip)
    for group in groups:
        some = {name: [values[i] for i in group] for name, values in per_clip.items()}
        grids = run.zeros((len(group), *shape[1:]), frames.device)
        own = [sensors[i] for i in group]
        out[group] = _fill(grids, own, frames[group], substeps, views, some)
    return out


def _fitting(out: Tensor, shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Return `out`, raising ValueError unless it is what the grids are."""
    found = (tuple(out.shape), out.device, out.dtype, out.is_contiguous())
    if found != (shape, device, torch.float32, True):
        raise ValueError(
            f"out must be contiguous float32 {shape} on {device}, got {out.dtype} {found[0]} on "
            f"{out.device}, contiguous: {found[3]}"
        )
    return out


def _groups(sensors: Sequence[Sensor]) -> list[list[int]]:
    """Return the numbers of the clips whose sensors can go together."""
    groups: dict[object, list[int]] = {}
    for i, sensor in enumerate(sensors):
        groups.setdefault(kind(sensor) if _is_ours(sensor) else i, []).append(i)
    return list(groups.values())


def _is_ours(sensor: Sensor) -> bool:
    return type(sensor) is EventSensor  # what is derived from it may do everything else


def _fill(grids, sensors, frames, substeps, views, per_clip) -> Tensor:
    """Fill the grids of clips that go together: of one kind, or one of another class."""
    if _is_ours(sensors[0]):
        job = make_job(sensors, frames, substeps=substeps, views=views, **per_clip)
        return run.voxels(job, grids)
    thresholds = per_clip.get("thresholds")
    found = sensors[0].voxels(
        frames.float(),
        per_clip["fps"][0],
        grids.shape[3],
        substeps=substeps,
        clips=per_clip["clips"],
        views=views,
        origin=per_clip["origins"][0],
        full_width=per_clip["full_widths"][0],
        threshold=None if thresholds is None else torch.tensor(thresholds),
    )
    return grids.copy_(found.transpose(1, 2))
