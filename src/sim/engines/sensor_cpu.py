"""Runs the CPU kernels: plain threads over disjoint rows, so in any thread and after a fork."""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from src.sim.engines.job import COUNT, LIST, NORMALS, VOXELS, Chip, Job, Memory, Sink
from src.sim.engines.sensor_numba import simulate

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Fill `grids` (n, views, windows, bins, h, w) and return them."""
    _run(job, VOXELS, voxels=grids.numpy())
    return grids


def counts(job: Job) -> Tensor:
    """Return the numbers of ON and OFF events, (n, views, 2)."""
    n, views, _, height, _ = job.frames.shape
    return torch.from_numpy(_counts(job).reshape(n, views, height, 2).sum(2))


def events(job: Job) -> np.ndarray:
    """Return the events in order of time: counted row by row, then filled in, then sorted."""
    state = copy.deepcopy(job.state)
    rows = _counts(job).sum(1)
    listed = np.empty(rows.sum(), EVENT)
    _run(replace(job, state=state), LIST, offsets=np.cumsum(rows) - rows, events=listed)
    return listed[np.argsort(listed["t"], kind="stable")]


def _counts(job: Job) -> np.ndarray:
    n, views, _, height, _ = job.frames.shape
    numbers = np.zeros((n * views * height, 2), np.int64)
    _run(job, COUNT, counts=numbers)
    return numbers


def _run(job: Job, output: int, **targets) -> None:
    """Run `simulate` over all units on as many threads as torch would use."""
    n, views, _, height, width = job.frames.shape
    nowhere = {
        "voxels": np.empty((n, views, 1, 1, height, width), np.float32),
        "counts": np.empty((0, 2), np.int64),
        "offsets": np.empty(0, np.int64),
        "events": np.empty(0, EVENT),
    }
    memory = (job.state.level, job.state.source, job.state.reference, job.state.dead)
    chip = Chip(
        tuple(part.numpy() for part in job.tables), NORMALS, job.chips, job.chip_keys,
        job.shot_keys, job.place, job.mode, job.v2e, np.float32(job.wait), job.leak, job.shot,
        job.hot,
    )  # fmt: skip
    arguments = (
        job.frames.numpy(), int(job.fresh), chip, Memory(*(part.numpy() for part in memory)),
        job.edges, job.state.frame, job.substeps, Sink(output, **nowhere | targets),
    )  # fmt: skip
    units = n * views * (1 if job.v2e else height)
    threads = min(torch.get_num_threads(), units)
    if threads == 1:
        simulate(0, units, *arguments)
        return
    cuts = [units * i // threads for i in range(threads + 1)]
    with ThreadPoolExecutor(threads) as pool:
        parts = [pool.submit(simulate, a, b, *arguments) for a, b in pairwise(cuts)]
        for part in parts:
            part.result()
