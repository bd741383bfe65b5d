"""Runs the CPU kernels: plain threads over disjoint pixels, so in any thread and after a fork."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from src.sim.sensor.engines.job import COUNT, LIST, NORMALS, VOXELS, Chip, Job, Memory, Sink
from src.sim.sensor.engines.sensor_numba import simulate
from src.sim.sensor.limits import check_intensities

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
UNIT = 8192  # pixels simulated together: their memory stays in the cache from frame to frame


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Add the events to `grids` (n, windows, views, bins, h, w) and return them."""
    _run(job, VOXELS, voxels=grids.view(*grids.shape[:4], -1).numpy())
    return grids


def counts(job: Job) -> Tensor:
    """Return the numbers of ON and OFF events, (n, views, 2)."""
    n, views = job.frames.shape[:2]
    return torch.from_numpy(_counts(job).reshape(n, views, -1, 2).sum(2))


def events(job: Job) -> np.ndarray:
    """Return the events in order of time: counted unit by unit, then filled in, then sorted."""
    state = copy.deepcopy(job.state)
    numbers = _counts(job).sum(1)
    listed = np.empty(numbers.sum(), EVENT)
    _run(replace(job, state=state), LIST, offsets=np.cumsum(numbers) - numbers, events=listed)
    return listed[np.argsort(listed["t"], kind="stable")]


def _unit(job: Job) -> tuple[int, int]:
    """Return the pixels of a unit and the number of units; with v2e's stamps a view is a unit."""
    n, views, _, height, width = job.frames.shape
    size = height * width if job.v2e else UNIT
    return size, n * views * -(-height * width // size)


def _counts(job: Job) -> np.ndarray:
    numbers = np.zeros((_unit(job)[1], 2), np.int64)
    _run(job, COUNT, counts=numbers)
    return numbers


def _run(job: Job, output: int, **targets) -> None:
    """Run `simulate` over all units on as many threads as torch would use.

    Raises ValueError, afterwards, for frames that are not finite or outside [0, 1].
    """
    nowhere = {
        "voxels": np.empty((0, 0, 0, 0, 0), np.float32),
        "counts": np.empty((0, 2), np.int64),
        "offsets": np.empty(0, np.int64),
        "events": np.empty(0, EVENT),
    }
    n, views = job.frames.shape[:2]
    state = (job.state.level, job.state.source, job.state.reference, job.state.dead)
    memory = Memory(*(part.view(n, views, -1).numpy() for part in state))
    chip = Chip(
        job.level.numpy(), job.low_pass.numpy(), NORMALS, job.clips, job.keys, job.frames.shape[4],
        job.mode, job.v2e,
    )  # fmt: skip
    size, units = _unit(job)
    arguments = (
        size, _light(job.frames), int(job.fresh), chip, memory, job.edges, job.state.frame,
        job.substeps, Sink(output, **nowhere | targets),
    )  # fmt: skip
    threads = min(torch.get_num_threads(), units)
    if threads == 1:
        doubtful = simulate(0, units, *arguments)
    else:
        cuts = [units * i // threads for i in range(threads + 1)]
        with ThreadPoolExecutor(threads) as pool:
            parts = [pool.submit(simulate, a, b, *arguments) for a, b in pairwise(cuts)]
            doubtful = any([part.result() for part in parts])
    if doubtful:
        check_intensities(job.frames)


def _light(frames: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the frames (n, views, frames, pixels) as the kernel takes them: float32, and the bits
    of float16, one of them empty.
    """
    flat, none = frames.flatten(3).contiguous(), (0, 0, 0, 0)
    if frames.dtype == torch.float16:
        return np.empty(none, np.float32), flat.view(torch.int16).numpy()
    return flat.numpy(), np.empty(none, np.int16)
