"""The sensor for CUDA as one kernel (Triton) for all clips and views of a batch: what a pixel is
and what it remembers stay in registers over the clip.

A program owns a run of pixels of one view, with all their bins, so that no sum depends on an order
other than that of time.  The formulas are those of sensor_numba.py, in integers and in
floats without fused multiply-add, so that the events are the same bit for bit.  v2e's stamps, for
which all pixels of a view must be known at once, are left to plain torch.
"""

from functools import lru_cache

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from src.sim.sensor.engines import job as jobs
from src.sim.sensor.engines.job import NORMALS, Job
from src.sim.sensor.engines.triton_pixel import (
    FIELDS,
    FULL_WIDTH,
    KEYS,
    LEAK,
    LEFT,
    LOW_PASS,
    NEVER,
    SHOT_KEY,
    TOP,
    WAIT,
    chip_of,
    filtered,
    is_outside,
    look,
    nearest,
    noise_chance,
    noise_event,
    number64,
    place_of,
    residual,
    way,
)
from src.sim.sensor.limits import check_intensities

BLOCK = 128  # pixels of a program
DELETE, HOLD = tl.constexpr(jobs.DELETE), tl.constexpr(jobs.HOLD)
SIZES = (
    "clip_step", "view_step", "frame_step", "row_step", "column_step", "n", "views", "pixels",
    "width", "intervals", "substeps", "first", "nodes",
)  # fmt: skip


def voxels(job: Job, grids: Tensor) -> Tensor:
    """Fill `grids` (n, windows, views, bins, h, w) and return them; `job.state` moves on.

    Raises ValueError, afterwards, for frames that are not finite or outside [0, 1].
    """
    n, views, _, height, width = job.frames.shape
    state, bins, device = job.state, grids.shape[3], grids.device
    numbers = np.concatenate([job.clips.view(np.int64), job.keys.ravel(), job.edges.ravel()])
    wrong = torch.zeros(1, dtype=torch.int32, device=device)
    noisy = job.clips["shot"].any() or job.clips["hot"].any()
    with torch.cuda.device_of(grids):
        _simulate[(triton.cdiv(height * width, BLOCK), n * views)](
            job.frames, state.level, state.source, state.reference, state.dead, job.level,
            job.low_pass, _normals(device), torch.from_numpy(numbers).to(device), grids, wrong,
            *job.frames.stride(), n, views, height * width, width, job.intervals, job.substeps,
            state.frame, job.low_pass.shape[2], job.mode, job.fresh, len(job.low_pass) > 0,
            bool(noisy), bins, triton.next_power_of_2(bins), BLOCK, enable_fp_fusion=False,
        )  # fmt: skip
    if wrong:
        check_intensities(job.frames)
    return grids


@lru_cache(maxsize=8)
def _normals(device: torch.device) -> Tensor:
    return torch.from_numpy(NORMALS).to(device)


@triton.jit(do_not_specialize=SIZES)
def _simulate(
    frames, levels, sources, references, deads, table, low_pass, normals, numbers, grids, wrong,
    clip_step, view_step, frame_step, row_step, column_step, n, views, pixels, width, intervals,
    substeps, first, nodes, MODE: tl.constexpr, FRESH: tl.constexpr, FILTERED: tl.constexpr,
    NOISY: tl.constexpr, BINS: tl.constexpr, COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Take BLOCK pixels of one clip and view through all intervals.

    `numbers`: the clips' (n, FIELDS), the keys (n, views, KEYS) and the edges (n, intervals + 1).
    """
    unit = tl.program_id(1).to(tl.int64)
    clip, view = unit // views, unit % views
    x = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    own, at = x < pixels, unit * pixels + x
    y = x // width
    row, col = y.to(tl.int64), (x - y * width).to(tl.int64)
    frame = frames + clip * clip_step + view * view_step + row * row_step + col * column_step
    chip, keys = numbers + clip * FIELDS, numbers + n * FIELDS + unit * KEYS
    edges = numbers + n * (FIELDS + views * KEYS) + clip * (intervals + 1)
    pixel = (tl.load(chip + TOP) + row) * tl.load(chip + FULL_WIDTH) + tl.load(chip + LEFT) + col
    on, off, hot = chip_of(chip, keys, normals, pixel)
    leak = on.to(tl.int64) * tl.load(chip + LEAK)
    wait = tl.zeros([BLOCK], tl.float32) + number64(chip + WAIT).to(tl.float32)
    key, begun = tl.load(keys + SHOT_KEY), tl.full((), 0, tl.int64) + first
    bad = tl.zeros([BLOCK], tl.int1)
    if FRESH:
        intensity = tl.load(frame, own, 0.0).to(tl.float32)
        bad = is_outside(intensity)
        level = look(table, place_of(intensity))
        ref = level - residual(chip, keys, pixel, on, off)
        source, dead = level, tl.zeros([BLOCK], tl.float32)
        frame += frame_step
    else:
        level, source = tl.load(levels + at, own, 0), tl.load(sources + at, own, 0)
        ref, dead = tl.load(references + at, own, 0), tl.load(deads + at, own, 0.0)
    decay = low_pass + 2 * nodes * tl.load(chip + LOW_PASS)
    column = tl.arange(0, COLUMNS)[None, :]
    grid = tl.zeros([BLOCK, COLUMNS], tl.float32)
    size = views * BINS * pixels.to(tl.int64)
    cell = grids + (clip * (intervals // substeps)) * size + view * BINS * pixels
    cell = cell + column * pixels + x[:, None]
    for i in range(intervals):
        intensity = tl.load(frame, own, 0.0).to(tl.float32)
        bad = bad | is_outside(intensity)
        place = place_of(intensity)
        read = look(table, place)
        new = read
        if FILTERED:
            kept, lag = look(decay, place), look(decay + nodes, place)
            new = filtered(read, level, source, kept, lag)
        drift = ((leak * (begun + i + 1) >> 24) - (leak * (begun + i) >> 24)).to(tl.int32)
        delta = new + drift - level
        along = tl.where(delta >= 0, 1, -1)
        ahead, behind = tl.where(delta >= 0, on, off), tl.where(delta >= 0, off, on)
        span, mark = tl.abs(delta), (ref - level) * along
        begin, ticks, scale = _clock(edges, i, substeps, BINS)
        start, holding = tl.zeros([BLOCK], tl.float32), (dead > 0) & (MODE == HOLD)
        if NOISY:
            u, sign = noise_event(key, begun + i, pixel, noise_chance(chip, hot, intensity))
            u = tl.where(own, u, NEVER)
            stop = tl.minimum(u, 1.0)
            grid, mark, dead, holding = _until(
                grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait,
                begin, ticks, scale, column, BINS, MODE,
            )  # fmt: skip
            fired = (u <= 1) & (u >= dead)
            grid = _add(grid, fired, u, sign, begin, ticks, scale, column, BINS)
            mark = tl.where(fired, way(span, u), mark)
            dead = tl.where(fired, u + wait, dead)
            holding = holding | (fired & (MODE == HOLD) & (wait > 0))
            start = stop
        grid, mark, dead, holding = _until(
            grid, mark, dead, holding, start, tl.full([BLOCK], 1, tl.float32), span, ahead, behind,
            along, own, wait, begin, ticks, scale, column, BINS, MODE,
        )  # fmt: skip
        ref, dead = level + mark * along - drift, tl.maximum(dead - 1, 0.0)
        level, source = new, read
        frame += frame_step
        if (i + 1) % substeps == 0:
            tl.store(cell, grid, own[:, None] & (column < BINS))
            grid = tl.zeros([BLOCK, COLUMNS], tl.float32)
            cell += size
    tl.store(levels + at, level, own)
    tl.store(sources + at, source, own)
    tl.store(references + at, ref, own)
    tl.store(deads + at, dead, own)
    tl.store(wrong + tl.zeros([BLOCK], tl.int32), 1, own & bad)


@triton.jit
def _clock(edges, i, substeps, BINS: tl.constexpr):
    """Return the interval's start in its window and its length, in us, and bins per us."""
    origin = i // substeps * substeps
    begin, window = tl.load(edges + i), tl.load(edges + origin)
    length = (tl.load(edges + origin + substeps) - window).to(tl.float32)
    scale = tl.math.div_rn(tl.full((), BINS - 1, tl.float32), length)
    return begin - window, tl.load(edges + i + 1) - begin, scale


@triton.jit
def _until(
    grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait, begin, ticks,
    scale, column, BINS: tl.constexpr, MODE: tl.constexpr,
):  # fmt: skip
    """Add the events from `start` to `stop`; `mark` is the reference's place on the level's way."""
    going = own
    while tl.max(going.to(tl.int32), 0) > 0:
        ends = holding & (dead <= stop)  # the reset ends
        mark = tl.where(ends, way(span, dead), mark)
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
    length = span.to(tl.float32)
    u = tl.math.div_rn((mark + ahead).to(tl.float32), tl.maximum(length, 1.0))
    u = tl.where(mark + ahead > span, NEVER, tl.maximum(u, now))
    before = (mark >= behind) & ((mark - behind).to(tl.float32) >= now * length)
    return tl.where(before, now, u), tl.where(before, -behind, ahead)


@triton.jit
def _add(grid, fired, u, sign, begin, ticks, scale, column, BINS: tl.constexpr):
    """Add the events of the pixels where `fired` to `grid` (pixels, columns), bilinear in time."""
    tick = tl.maximum(tl.ceil(u * ticks.to(tl.float32)).to(tl.int64) - 1, 0) + begin
    tau = tick.to(tl.float32) * scale
    b = tl.minimum(tau.to(tl.int32), BINS - 1)
    late = nearest((tau - b.to(tl.float32)) * 1048576.0) * (1 / 1048576.0)
    sign = tl.where(fired, sign, 0).to(tl.float32)
    grid += tl.where(column == b[:, None], (sign * (1 - late))[:, None], 0.0)
    return grid + tl.where(column == b[:, None] + 1, (sign * late)[:, None], 0.0)
