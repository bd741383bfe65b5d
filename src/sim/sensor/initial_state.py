"""What pixels remember when a clip begins."""

from dataclasses import replace

import torch

from src.sim import noise
from src.sim.sensor.engines import sensor_eager
from src.sim.sensor.engines.job import Job, State


def blank(n: int, views: int, h: int, w: int, device: torch.device) -> State:
    """Return memory to be filled by a first frame."""
    shape = (n, views, h, w)
    levels = (torch.empty(shape, dtype=torch.int32, device=device) for _ in range(3))
    return State(*levels, torch.empty(shape, device=device))


def rested(job: Job, residual: float) -> Job:
    """Return the job with its first frame in the memory, and the references off from it."""
    pixels, state = sensor_eager.Pixels(job), job.state
    pixels.start(job.frames[:, :, 0])
    keys = [[noise.key(int(key), "residual") for key in row] for row in job.shot_keys]
    keys = torch.tensor(keys, device=pixels.pixel.device)[:, :, None, None]
    away = (2 * noise.uniform(keys, pixels.pixel) - 1).double() * residual
    off = (away * torch.where(away > 0, pixels.on, pixels.off)).int()
    state.reference = state.level - off
    return replace(job, frames=job.frames[:, :, 1:], fresh=False)
