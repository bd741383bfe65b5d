"""The sensor for CUDA as one kernel (Triton): a pixel's memory stays in registers over the clip.

A program owns a run of pixels of one view, with all their bins, so that no sum depends on an order
other than that of time.  The formulas are those of sensor_numba.py, in integers and in
floats without fused multiply-add, so that the events are the same bit for bit.  v2e's stamps, for
which all pixels of a view must be known at once, are left to plain torch.
"""

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from src.sim.sensor.engines import job as jobs
from src.sim.sensor.engines.job import Job
from src.sim.sensor.engines.sensor_eager import Pixels

BLOCK = 128  # pixels of a program
DELETE, HOLD = tl.constexpr(jobs.DELETE), tl.constexpr(jobs.HOLD)
NEVER = tl.constexpr(2.0)  # a time after the interval


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Fill `grids` (n, views, windows, bins, h, w) and return them; `job.state` moves on."""
    n, views, samples, height, width = job.frames.shape
    chip, state, bins = Pixels(job), job.state, grids.shape[3]
    memory = (state.level, state.source, state.reference, state.dead)
    clock, scales = _clock(job, bins)
    numbers = np.array([job.leak, job.shot, job.hot, state.frame], np.int64)
    on_device = (
        torch.from_numpy(part).to(job.frames.device)
        for part in (job.shot_keys, numbers, clock, scales)
    )
    pixels = height * width
    with torch.cuda.device_of(grids):
        _simulate[(triton.cdiv(pixels, BLOCK), n * views)](
            job.frames.contiguous(), *memory, chip.on, chip.off, chip.hot.contiguous(), chip.pixel,
            *job.tables, *on_device, grids, float(np.float32(job.wait)), pixels, samples,
            job.intervals, job.substeps, job.mode, int(job.fresh), len(job.tables[1]) > 1,
            max(job.shot, job.hot) > 0, bins, triton.next_power_of_2(bins), BLOCK,
            enable_fp_fusion=False,
        )  # fmt: skip
    return grids


def _clock(job: Job, bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return (intervals, 2), start in the window and length in us, and windows' bins per us."""
    starts = job.edges[:: job.substeps]
    begins = job.edges[:-1] - np.repeat(starts[:-1], job.substeps)
    scales = np.float32(bins - 1) / np.diff(starts).astype(np.float32)
    return np.stack([begins, np.diff(job.edges)], 1), scales


@triton.jit
def _simulate(
    frames, levels, sources, references, deads, ons, offs, hots, numbering, table, decay, lag, keys,
    numbers, clock, scales, grids, wait, pixels, samples, intervals, substeps, MODE: tl.constexpr,
    FRESH: tl.constexpr, FILTERED: tl.constexpr, NOISY: tl.constexpr, BINS: tl.constexpr,
    COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Take BLOCK pixels of one clip and view through all intervals."""
    unit = tl.program_id(1).to(tl.int64)
    x = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    own, at = x < pixels, unit * pixels + x
    on, off = tl.load(ons + at, own, 1).to(tl.int32), tl.load(offs + at, own, 1).to(tl.int32)
    leak, first = on.to(tl.int64) * tl.load(numbers), tl.load(numbers + 3)
    level, source = tl.load(levels + at, own, 0), tl.load(sources + at, own, 0)
    ref, dead = tl.load(references + at, own, 0), tl.load(deads + at, own, 0.0)
    frame = frames + unit * samples * pixels + x
    if FRESH:
        level = _look(table, _place(tl.load(frame, own, 0.0)))
        source, ref, dead = level, level, tl.zeros([BLOCK], tl.float32)
        frame += pixels
    column = tl.arange(0, COLUMNS)[None, :]
    grid = tl.zeros([BLOCK, COLUMNS], tl.float32)
    cell = grids + unit * (intervals // substeps) * BINS * pixels + column * pixels + x[:, None]
    for i in range(intervals):
        intensity = tl.load(frame, own, 0.0)
        place = _place(intensity)
        read = _look(table, place)
        new = read
        if FILTERED:
            new = _low_pass(read, level, source, _look(decay, place), _look(lag, place))
        drift = ((leak * (first + i + 1) >> 24) - (leak * (first + i) >> 24)).to(tl.int32)
        delta = new + drift - level
        along = tl.where(delta >= 0, 1, -1)
        ahead, behind = tl.where(delta >= 0, on, off), tl.where(delta >= 0, off, on)
        span, mark = tl.abs(delta), (ref - level) * along
        begin, ticks = tl.load(clock + 2 * i), tl.load(clock + 2 * i + 1)
        scale = tl.load(scales + i // substeps)
        start, holding = tl.zeros([BLOCK], tl.float32), (dead > 0) & (MODE == HOLD)
        if NOISY:
            chance = _chance(numbers, tl.load(hots + at, own, 0), intensity)
            u, sign = _noise(
                tl.load(keys + unit), first + i, tl.load(numbering + x, own, 0), chance
            )
            u = tl.where(own, u, NEVER)
            stop = tl.minimum(u, 1.0)
            grid, mark, dead, holding = _until(
                grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait,
                begin, ticks, scale, column, BINS, MODE,
            )  # fmt: skip
            fired = (u <= 1) & (u >= dead)
            grid = _add(grid, fired, u, sign, begin, ticks, scale, column, BINS)
            mark = tl.where(fired, _way(span, u), mark)
            dead = tl.where(fired, u + wait, dead)
            holding = holding | (fired & (MODE == HOLD) & (wait > 0))
            start = stop
        grid, mark, dead, holding = _until(
            grid, mark, dead, holding, start, tl.full([BLOCK], 1, tl.float32), span, ahead, behind,
            along, own, wait, begin, ticks, scale, column, BINS, MODE,
        )  # fmt: skip
        ref, dead = level + mark * along - drift, tl.maximum(dead - 1, 0.0)
        level, source = new, read
        frame += pixels
        if (i + 1) % substeps == 0:
            tl.store(cell, grid, own[:, None] & (column < BINS))
            grid = tl.zeros([BLOCK, COLUMNS], tl.float32)
            cell += BINS * pixels
    tl.store(levels + at, level, own)
    tl.store(sources + at, source, own)
    tl.store(references + at, ref, own)
    tl.store(deads + at, dead, own)


@triton.jit
def _until(
    grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait, begin, ticks,
    scale, column, BINS: tl.constexpr, MODE: tl.constexpr,
):  # fmt: skip
    """Add the events from `start` to `stop`; `mark` is the reference's place on the level's way."""
    going = own
    while tl.max(going.to(tl.int32), 0) > 0:
        ends = holding & (dead <= stop)  # the reset ends
        mark = tl.where(ends, _way(span, dead), mark)
        holding = holding & (dead > stop)
        now = start
        if MODE != DELETE:
            now = tl.maximum(start, dead)
        u, step = _next(span, mark, ahead, behind, now)
        going = going & (u <= stop) & (holding == 0)
        mark = tl.where(going, mark + step, mark)
        start = tl.where(going, u, start)
        fired = going & (u >= dead)
        sign = tl.where(step > 0, along, -along)
        grid = _add(grid, fired, u, sign, begin, ticks, scale, column, BINS)
        dead = tl.where(fired, u + wait, dead)
        holding = holding | (fired & (MODE == HOLD) & (wait > 0))
    return grid, mark, dead, holding


@triton.jit
def _next(span, mark, ahead, behind, now):
    """Return time and step of the first threshold exceeded at or after `now`; NEVER if none."""
    way = span.to(tl.float32)
    u = tl.math.div_rn((mark + ahead).to(tl.float32), tl.maximum(way, 1.0))
    u = tl.where(mark + ahead > span, NEVER, tl.maximum(u, now))
    before = (mark >= behind) & ((mark - behind).to(tl.float32) >= now * way)
    return tl.where(before, now, u), tl.where(before, -behind, ahead)


@triton.jit
def _add(grid, fired, u, sign, begin, ticks, scale, column, BINS: tl.constexpr):
    """Add the events of the pixels where `fired` to `grid` (pixels, columns), bilinear in time."""
    tick = tl.maximum(tl.ceil(u * ticks.to(tl.float32)).to(tl.int64) - 1, 0) + begin
    tau = tick.to(tl.float32) * scale
    b = tl.minimum(tau.to(tl.int32), BINS - 1)
    late = _whole((tau - b.to(tl.float32)) * 1048576.0) * (1 / 1048576.0)
    sign = tl.where(fired, sign, 0).to(tl.float32)
    grid += tl.where(column == b[:, None], (sign * (1 - late))[:, None], 0.0)
    return grid + tl.where(column == b[:, None] + 1, (sign * late)[:, None], 0.0)


@triton.jit
def _chance(numbers, hot, intensity):
    """Return the probability of a noise event in 2**-32; at white it is a quarter of black's."""
    shot, hot_rate = tl.load(numbers + 1), tl.load(numbers + 2)
    seen = (tl.minimum(tl.maximum(intensity, 0.0), 1.0) * 256.0).to(tl.int64)
    return tl.where(hot != 0, hot_rate, shot - (shot >> 8) * ((3 * seen) >> 2))


@triton.jit
def _noise(key, frame, pixel, chance):
    """Return time (NEVER for none) and polarity of the noise events of interval `frame`."""
    drawn, at = _bits(key, frame, 2 * pixel), _bits(key, frame, 2 * pixel + 1)
    u = ((at >> 9).to(tl.float32) + 0.5) * (1 / 8388608.0)
    return tl.where(drawn.to(tl.int64) < chance, u, NEVER), tl.where(at & 1 == 1, 1, -1)


@triton.jit
def _bits(key, high, low):
    """The 32 bits of src.sim.noise.bits(key, high * 2**32 + low)."""
    mixed = _mix(low.to(tl.uint32) ^ (key & 0xFFFFFFFF).to(tl.uint32))
    upper = high.to(tl.uint32) * 0x9E3779B9 + (key >> 32).to(tl.uint32)
    return _mix(mixed + upper)


@triton.jit
def _mix(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


@triton.jit
def _place(intensity):
    """Return the place in the tables of an intensity, as src.sim.sensor.response.lookup has it."""
    bits = intensity.to(tl.int32, bitcast=True)
    return tl.minimum(tl.maximum(bits, 0x38800000), 0x3FFFFFFF) - 0x38800000


@triton.jit
def _low_pass(read, level, source, decay, lag):
    """Return the new level after the low-pass from the one before it, `read`, and the memory."""
    kept = (level - source).to(tl.int64) * decay - (read - source).to(tl.int64) * lag
    return read + ((kept + 524288) >> 20).to(tl.int32)


@triton.jit
def _look(table, place):
    """Return the table's value at a place."""
    left, right = tl.load(table + (place >> 13)), tl.load(table + (place >> 13) + 1)
    return (left + (((right - left) * (place & 8191)) >> 13) + 8) >> 4


@triton.jit
def _way(span, u):
    """Return how far a level that moves by `span` in an interval has come at fraction `u`."""
    return _whole(u * span.to(tl.float32)).to(tl.int32)


@triton.jit
def _whole(x):
    """Return `x`, not negative, rounded to the nearest whole number, halves to even."""
    return tl.where(x < 8388608.0, x + 8388608.0 - 8388608.0, x)
