"""The sensor on the CPU: rows of (clip, view) through all intervals, straight into voxel grids.

The kernels release the interpreter's lock and are run by plain threads over disjoint units, so
that they work in any thread and after a fork.  A unit is one row; v2e's time stamps need the
busiest pixel of the whole view, so there it is one view.
"""

import copy
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch
from numba import njit, uint32, uint64
from torch import Tensor

from src.sim.engines.job import NORMALS, Job
from src.sim.engines.sensor_pixel import (
    HOLD,
    bits,
    linear_events,
    v2e_events,
    v2e_crossings,
)

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
VOXELS, COUNT, LIST = 0, 1, 2
NO_VOXELS = np.empty((0, 0, 0, 2, 0, 0), np.float32)
NO_COUNTS, NO_OFFSETS, NO_EVENTS = np.empty((0, 2), np.int64), np.empty(0, np.int64), np.empty(0, EVENT)
f32 = np.float32


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


def _run(job: Job, output: int, voxels=NO_VOXELS, counts=NO_COUNTS, offsets=NO_OFFSETS,
         events=NO_EVENTS) -> None:  # fmt: skip
    """Run `simulate` over all units on as many threads as torch would use."""
    n, views, _, height, _ = job.frames.shape
    units = n * views * (1 if job.v2e else height)
    state = job.state
    arguments = (
        job.frames.numpy(), int(job.fresh), tuple(part.numpy() for part in job.tables), NORMALS,
        tuple(part.numpy() for part in (state.level, state.source, state.reference, state.dead)),
        job.edges, (state.frame, job.substeps, f32(job.wait)),
        (job.mode, job.v2e, job.leak, job.shot, job.hot), job.chips, job.chip_keys, job.shot_keys,
        job.place, output, voxels, counts, offsets, events,
    )  # fmt: skip
    threads = min(torch.get_num_threads(), units)
    cuts = [units * i // threads for i in range(threads + 1)]
    if threads == 1:
        simulate(0, units, *arguments)
        return
    with ThreadPoolExecutor(threads) as pool:
        parts = [pool.submit(simulate, a, b, *arguments) for a, b in pairwise(cuts)]
        for part in parts:
            part.result()


@njit(nogil=True, inline="always")
def look(table, place, shift):
    """Return the table's value at the bits of one intensity, as src.sim.response.lookup does."""
    cell, inside = place >> 13, place & 8191
    left = table[cell]
    return (left + (((table[cell + 1] - left) * inside) >> 13) + (1 << (shift - 1))) >> shift


@njit(nogil=True)
def pixel_row(chip, normals, view_keys, pixel, on, off, hot):
    """Fill one row of thresholds `on`, `off` and of `hot`: what the chip is, whatever it sees."""
    threshold_on, threshold_off, spread, hot_share = chip
    for x in range(on.size):
        on[x], off[x], hot[x] = threshold_on, threshold_off, False
        if spread > 0:
            at = 2 * (pixel + x)
            on[x] = spread_threshold(threshold_on, spread, normals, bits(view_keys[0], 0, at))
            off[x] = spread_threshold(threshold_off, spread, normals, bits(view_keys[0], 0, at + 1))
        if hot_share > 0:
            hot[x] = bits(view_keys[1], 0, pixel + x) < hot_share


@njit(nogil=True, inline="always")
def spread_threshold(threshold, spread, normals, drawn):
    """Return threshold * (1 + spread * normal), at least a quarter of the threshold."""
    cell, inside = np.int64(drawn >> uint32(20)), np.int64(drawn & uint32(0xFFFFF))
    normal = normals[cell] + (((normals[cell + 1] - normals[cell]) * inside) >> 20)
    return max(threshold + ((((threshold * spread) >> 20) * normal) >> 20), threshold >> 2)


@njit(nogil=True)
def new_levels(frame, table, decay, ramp, source, level, new_source, new_level):
    """Fill one row with the levels of a frame, through the photoreceptor's low-pass if there is one."""
    places = frame.view(np.int32)
    for x in range(frame.size):
        place = np.int64(min(max(places[x], 0x38800000), 0x3FFFFFFF) - 0x38800000)
        y = look(table, place, 4)
        new_source[x], new_level[x] = y, y
        if decay.size > 1:
            keep, lag = look(decay, place, 4), look(ramp, place, 4)
            old = np.int64(level[x] - source[x]) * keep - np.int64(y - source[x]) * lag
            new_level[x] = y + ((old + 524288) >> 20)


@njit(nogil=True, inline="always")
def noise_event(key, frame, pixel, rate):
    """Return (time, polarity) of a noise event of probability rate / 2**32; time 2 for none."""
    drawn = bits(key, frame, 2 * pixel)
    if uint64(drawn) >= uint64(rate):
        return f32(2), 1
    at = bits(key, frame, 2 * pixel + 1)
    return (f32(at >> uint32(9)) + f32(0.5)) * f32(2.0**-23), 1 if at & uint32(1) else -1


@njit(nogil=True, inline="always")
def noise_rate(base, x):
    """Return the probability of a noise event at intensity x: a quarter at white (v2e)."""
    seen = np.int64(min(max(x, f32(0)), f32(1)) * f32(256))
    return base - (base >> 8) * ((3 * seen) >> 2)


@njit(nogil=True, inline="always")
def leaked(leak, threshold, frame):
    """Return how far the reference leaks in interval `frame`, by its whole units so far."""
    return ((threshold * leak * (frame + 1)) >> 24) - ((threshold * leak * frame) >> 24)


@njit(nogil=True, inline="always")
def add_to_grid(grid, y, x, ticks, scale, sign):
    """Add one event `ticks` microseconds into the window to `grid` (bins, h, w)."""
    bins = grid.shape[0]
    tau = f32(f32(ticks) * scale)
    b = min(np.int64(tau), bins - 1)
    late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
    grid[b, y, x] += f32(sign) * (f32(1) - late)
    if late > 0 and b + 1 < bins:
        grid[b + 1, y, x] += f32(sign) * late


@njit(nogil=True)
def begin(frame, table, chip, normals, keys, pixel, fresh, memory, on, off, hot):
    """Set up one row: its pixels, and if it is `fresh` the memory of the first frame."""
    source, level, reference, dead = memory
    pixel_row(chip, normals, keys, pixel, on, off, hot)
    if fresh:
        new_levels(frame, table, table[:1], table[:1], source, level, source, level)
        reference[:] = level
        dead[:] = f32(0)


@njit(nogil=True)
def busiest(levels, new_level, references, deads, on, off, leak, frame, mode):
    """Return the largest number of crossings of any pixel of a view, at least 1."""
    steps = np.int64(1)
    for y in range(levels.shape[0]):
        for x in range(levels.shape[1]):
            l1 = new_level[y, x] + leaked(leak, on[y, x], frame)
            crossings, _ = v2e_crossings(
                np.int64(levels[y, x]), l1, np.int64(references[y, x]), deads[y, x],
                on[y, x], off[y, x], mode,
            )  # fmt: skip
            steps = max(steps, crossings)
    return steps


@njit(nogil=True, inline="always")
def noise_at(model, frame, x, intensity, hot, key, pixel):
    """Return (time, polarity) of the noise event of one pixel and interval, time 2 for none."""
    shot, hot_rate = model[3], model[4]
    if shot == 0 and not hot:
        return f32(2), 1
    return noise_event(key, frame, pixel, hot_rate if hot else noise_rate(shot, intensity))


@njit(nogil=True, cache=True)
def simulate(
    first_unit, last_unit, frames, fresh, tables, normals, state, edges, clock, model, chips,
    chip_keys, shot_keys, place, output, voxels, counts, offsets, events,
):  # fmt: skip
    """Simulate units first_unit .. last_unit - 1; src.sim.sensor makes the arguments."""
    levels, sources, references, deads = state
    first_frame, substeps, wait = clock
    mode, v2e, leak = model[0], model[1], model[2]
    top, left, full_width = place
    _, views, samples, height, width = frames.shape
    rows = height if v2e else 1
    on, off = np.empty((rows, width), np.int64), np.empty((rows, width), np.int64)
    hot = np.empty((rows, width), np.bool_)
    new_level, new_source = np.empty((2, rows, width), np.int32)
    room = 32 + (1 << 25) // max(chips[:, :2].min() >> 2, 1024)
    when, sign = np.empty(room, np.float32), np.empty(room, np.int8)
    for unit in range(first_unit, last_unit):
        c, v, y0 = locate(unit, views, height // rows, rows)
        for r in range(rows):
            y = y0 + r
            memory = (sources[c, v, y], levels[c, v, y], references[c, v, y], deads[c, v, y])
            begin(
                frames[c, v, 0, y], tables[0], chips[c], normals, chip_keys[v],
                (top + y) * full_width + left, fresh, memory, on[r], off[r], hot[r],
            )  # fmt: skip
        for i in range(samples - fresh):
            frame = first_frame + i
            for r in range(rows):
                y = y0 + r
                new_levels(
                    frames[c, v, i + fresh, y], tables[0], tables[1], tables[2],
                    sources[c, v, y], levels[c, v, y], new_source[r], new_level[r],
                )  # fmt: skip
            steps = np.int64(1)
            if v2e:
                steps = busiest(
                    levels[c, v], new_level, references[c, v], deads[c, v], on, off, leak, frame,
                    mode,
                )  # fmt: skip
            window = i // substeps
            origin, end = edges[window * substeps], edges[(window + 1) * substeps]
            scale = f32(f32(voxels.shape[3] - 1) / f32(end - origin))
            for r in range(rows):
                y = y0 + r
                row = (c * views + v) * height + y
                if output == VOXELS and i % substeps == 0:
                    voxels[c, v, window, :, y, :] = f32(0)
                level, reference, dead_row = levels[c, v, y], references[c, v, y], deads[c, v, y]
                seen = frames[c, v, i + fresh, y]
                pixel = (top + y) * full_width + left
                for x in range(width):
                    l0, ref, dead = np.int64(level[x]), np.int64(reference[x]), dead_row[x]
                    drift = leaked(leak, on[r, x], frame) if leak else np.int64(0)
                    l1 = np.int64(new_level[r, x]) + drift
                    u, s = noise_at(
                        model, frame, x, seen[x], hot[r, x], shot_keys[c, v], pixel + x
                    )
                    quiet = max(l0, l1) < ref + on[r, x] and min(l0, l1) > ref - off[r, x]
                    count = 0
                    if not quiet or u <= 1 or (mode == HOLD and dead > 0):
                        if v2e:
                            count, ref, dead = v2e_events(
                                l0, l1, ref, dead, on[r, x], off[r, x], wait, mode, steps,
                                u, s, when, sign,
                            )  # fmt: skip
                        else:
                            count, ref, dead = linear_events(
                                l0, l1, ref, dead, on[r, x], off[r, x], wait, mode,
                                u, s, when, sign,
                            )  # fmt: skip
                    reference[x] = ref - drift
                    dead_row[x] = max(dead - f32(1), f32(0))
                    for k in range(count):
                        tick = np.int64(np.ceil(when[k] * f32(edges[i + 1] - edges[i]))) - 1
                        t = edges[i] + max(tick, 0)
                        if output == VOXELS:
                            add_to_grid(voxels[c, v, window], y, x, t - origin, scale, sign[k])
                        elif output == COUNT:
                            counts[row, 0 if sign[k] > 0 else 1] += 1
                        else:
                            at = offsets[row]
                            offsets[row] = at + 1
                            events[at].t, events[at].x, events[at].y = t, x, y
                            events[at].p = sign[k]
                    level[x] = new_level[r, x]
                sources[c, v, y] = new_source[r]


@njit(nogil=True, inline="always")
def locate(unit, views, units, rows):
    """Return (clip, view, first row) of a unit."""
    return unit // (views * units), unit // units % views, unit % units * rows
