"""Runs the CPU kernels: plain threads over disjoint pixels, so in any thread and after a fork."""

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from src.sim.sensor.engines.records import EVENT, NORMALS, EngineInput, Grids, check_intensities
from src.sim.sensor.engines.sensor_numba import simulate_pixel_blocks

UNIT = 8192  # pixels simulated together: their memory stays in the cache from frame to frame
NO_GRIDS, NO_EVENTS = np.empty((0, 0, 0, 0, 0), np.float32), np.empty(0, EVENT)


def voxels(given: EngineInput, grids: Grids) -> Grids:
    """Add the events to `grids` and return them."""
    _run(given, grids.view(*grids.shape[:4], -1).numpy(), np.empty((0, 2), np.int64), NO_EVENTS)
    return grids


def counts(given: EngineInput) -> Int[Tensor, "n views 2"]:
    """Return the numbers of ON and OFF events."""
    n, views = given.frames.shape[:2]
    return torch.from_numpy(_unit_counts(given).reshape(n, views, -1, 2).sum(2))


def events(given: EngineInput) -> np.ndarray:
    """Return the events in order of time: counted unit by unit, then filled in, then sorted."""
    totals = _unit_counts(given).sum(1, keepdims=True)
    listed = np.empty(totals.sum(), EVENT)
    _run(given, NO_GRIDS, np.cumsum(totals, 0) - totals, listed)
    return listed[np.argsort(listed["t"], kind="stable")]


def _unit(given: EngineInput) -> tuple[int, int]:
    """Return the pixels of a unit, with v2e's stamps those of a view, and the number of units."""
    n, views, _, height, width = given.frames.shape
    size = height * width if given.v2e_stamps else UNIT
    return size, n * views * -(-height * width // size)


def _unit_counts(given: EngineInput) -> np.ndarray:
    numbers = np.zeros((_unit(given)[1], 2), np.int64)
    _run(given, NO_GRIDS, numbers, NO_EVENTS)
    return numbers


def _run(given: EngineInput, grids: np.ndarray, tally: np.ndarray, events: np.ndarray) -> None:
    """Run `simulate_pixel_blocks` over all units on as many threads as torch would use.

    Raises ValueError, afterwards, for frames that are not finite or outside [0, 1].
    """
    size, units = _unit(given)
    flat, none = given.frames.cpu().flatten(3).contiguous(), (0, 0, 0, 0)
    half = flat.dtype == torch.float16
    kernel_input = given._replace(
        frames=np.empty(none, np.float32) if half else flat.numpy(),
        level_table=given.level_table.cpu().numpy(),
        low_pass_tables=given.low_pass_tables.cpu().numpy(),
    )
    half_frames = flat.view(torch.int16).numpy() if half else np.empty(none, np.int16)
    arguments = kernel_input, half_frames, NORMALS, flat.shape[3], size, grids, tally, events
    threads = min(torch.get_num_threads(), units)
    if threads == 1:
        doubtful = simulate_pixel_blocks(0, units, *arguments)
    else:
        cuts = [units * i // threads for i in range(threads + 1)]
        with ThreadPoolExecutor(threads) as pool:
            parts = [
                pool.submit(simulate_pixel_blocks, a, b, *arguments) for a, b in pairwise(cuts)
            ]
            doubtful = any([part.result() for part in parts])
    if doubtful:
        check_intensities(given.frames)
