"""The sensor for CUDA as one kernel (Triton) for all clips and views of a batch: what a pixel is
and what it remembers stay in registers over the clip.

A program owns a run of pixels of one view, with all their bins, so that no sum depends on an order
other than that of time.  The formulas are those of sensor_numba.py, in integers and in
floats without fused multiply-add, so that the events are the same bit for bit.  v2e's stamps, for
which all pixels of a view must be known at once, are left to the CPU.  `clip` points to the numbers
of a clip, in the order of records.FIELDS; `keys` to the keys of one of its views.
"""

from functools import lru_cache

import numpy as np
import torch
import triton
import triton.language as tl
from torch import Tensor

from src.sim.sensor.engines import records
from src.sim.sensor.engines.records import NORMALS, EngineInput, Grids, check_intensities

LOWEST, HIGHEST = tl.constexpr(records.LOWEST), tl.constexpr(records.HIGHEST)
NEVER = tl.constexpr(2.0)  # a time after the interval
FIELDS, KEYS = tl.constexpr(len(records.FIELDS)), tl.constexpr(records.KEYS)
(
    ON, OFF, MISMATCH, HOT_FRACTION, LEAK, DARK_NOISE, HOT_NOISE, TOP, LEFT, FULL_WIDTH,
    LOW_PASS_ROW, REFRACTORY, REFERENCE_ZERO, REFERENCE_SPAN,
) = map(tl.constexpr, range(len(records.FIELDS)))  # fmt: skip
MISMATCH_KEY, HOT_PIXEL_KEY, NOISE_KEY, REFERENCE_KEY = map(tl.constexpr, range(records.KEYS))
BLOCK = 128  # pixels of a program
DELETE, HOLD = tl.constexpr(records.DELETE), tl.constexpr(records.HOLD)
SIZES = (
    "clip_step", "view_step", "frame_step", "row_step", "column_step", "n", "views", "pixels",
    "width", "intervals", "substeps", "nodes",
)  # fmt: skip


def voxels(given: EngineInput, grids: Grids) -> Grids:
    """Fill `grids` and return them.

    Raises ValueError, afterwards, for frames that are not finite or outside [0, 1].
    """
    n, views, frames, height, width = given.frames.shape
    bins, device, clips = grids.shape[3], grids.device, given.clips
    numbers = np.concatenate([clips.view(np.int64), given.keys.ravel(), given.edges_us.ravel()])
    wrong = torch.zeros(1, dtype=torch.int32, device=device)
    noisy = clips["dark_noise"].any() or clips["hot_noise"].any()
    with torch.cuda.device_of(grids):
        _simulate[(triton.cdiv(height * width, BLOCK), n * views)](
            given.frames, given.level_table, given.low_pass_tables, _normals(device),
            torch.from_numpy(numbers).to(device), grids, wrong, *given.frames.stride(), n, views,
            height * width, width, frames - 1, given.substeps, given.low_pass_tables.shape[2],
            given.refractory_mode, len(given.low_pass_tables) > 0, bool(noisy), bins,
            triton.next_power_of_2(bins), BLOCK, enable_fp_fusion=False,
        )  # fmt: skip
    if wrong:
        check_intensities(given.frames)
    return grids


@lru_cache(maxsize=8)
def _normals(device: torch.device) -> Tensor:
    return torch.from_numpy(NORMALS).to(device)


@triton.jit(do_not_specialize=SIZES)
def _simulate(
    frames, level_table, low_pass_tables, normals, numbers, grids, wrong, clip_step, view_step,
    frame_step, row_step, column_step, n, views, pixels, width, intervals, substeps, nodes,
    MODE: tl.constexpr, FILTERED: tl.constexpr, NOISY: tl.constexpr, BINS: tl.constexpr,
    COLUMNS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Take BLOCK pixels of one clip and view through all intervals.

    `numbers`: the clips' (n, FIELDS), the keys (n, views, KEYS) and the edges (n, intervals + 1).
    """
    unit = tl.program_id(1).to(tl.int64)
    index, view = unit // views, unit % views
    x = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    own, y = x < pixels, x // width
    row, col = y.to(tl.int64), (x - y * width).to(tl.int64)
    frame = frames + index * clip_step + view * view_step + row * row_step + col * column_step
    clip, keys = numbers + index * FIELDS, numbers + n * FIELDS + unit * KEYS
    edges = numbers + n * (FIELDS + views * KEYS) + index * (intervals + 1)
    pixel = (tl.load(clip + TOP) + row) * tl.load(clip + FULL_WIDTH) + tl.load(clip + LEFT) + col
    on, off, hot = draw_thresholds_and_hot_pixels(clip, keys, normals, pixel)
    leak = on.to(tl.int64) * tl.load(clip + LEAK)
    wait = tl.zeros([BLOCK], tl.float32) + load_int64_as_float64(clip + REFRACTORY).to(tl.float32)
    key, zero = tl.load(keys + NOISE_KEY), tl.full((), 0, tl.int64)
    intensity = tl.load(frame, own, 0.0).to(tl.float32)
    bad = is_outside(intensity)
    level = read_table(level_table, fixed_point_table_position(intensity))
    ref = level - draw_level_minus_reference(clip, keys, pixel, on, off)
    source, dead = level, tl.zeros([BLOCK], tl.float32)
    frame += frame_step
    decay = low_pass_tables + 2 * nodes * tl.load(clip + LOW_PASS_ROW)
    column = tl.arange(0, COLUMNS)[None, :]
    grid = tl.zeros([BLOCK, COLUMNS], tl.float32)
    size = views * BINS * pixels.to(tl.int64)
    cell = grids + (index * (intervals // substeps)) * size + view * BINS * pixels
    cell = cell + column * pixels + x[:, None]
    for i in range(intervals):
        intensity = tl.load(frame, own, 0.0).to(tl.float32)
        bad = bad | is_outside(intensity)
        place = fixed_point_table_position(intensity)
        read = read_table(level_table, place)
        new = read
        if FILTERED:
            kept, lag = read_table(decay, place), read_table(decay + nodes, place)
            new = apply_low_pass(kept, lag, level, source, read)
        drift = ((leak * (zero + i + 1) >> 24) - (leak * (zero + i) >> 24)).to(tl.int32)
        delta = new + drift - level
        along = tl.where(delta >= 0, 1, -1)
        ahead, behind = tl.where(delta >= 0, on, off), tl.where(delta >= 0, off, on)
        span, mark = tl.abs(delta), (ref - level) * along
        begin, ticks, scale = _interval_clock(edges, i, substeps, BINS)
        start, holding = tl.zeros([BLOCK], tl.float32), (dead > 0) & (MODE == HOLD)
        if NOISY:
            likely = noise_probability(clip, hot, intensity)
            u, sign = draw_timed_noise_event(key, zero + i, pixel, likely)
            u = tl.where(own, u, NEVER)
            stop = tl.minimum(u, 1.0)
            grid, mark, dead, holding = _add_events(
                grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait,
                begin, ticks, scale, column, BINS, MODE,
            )  # fmt: skip
            fired = (u <= 1) & (u >= dead)
            grid = _add_to_grid(grid, fired, u, sign, begin, ticks, scale, column, BINS)
            mark = tl.where(fired, level_change_at(span, u), mark)
            dead = tl.where(fired, u + wait, dead)
            holding = holding | (fired & (MODE == HOLD) & (wait > 0))
            start = stop
        grid, mark, dead, holding = _add_events(
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
    tl.store(wrong + tl.zeros([BLOCK], tl.int32), 1, own & bad)


@triton.jit
def _interval_clock(edges, i, substeps, BINS: tl.constexpr):
    """Return the interval's start in its window and its length, in us, and bins per us."""
    origin = i // substeps * substeps
    begin, window = tl.load(edges + i), tl.load(edges + origin)
    length = (tl.load(edges + origin + substeps) - window).to(tl.float32)
    scale = tl.math.div_rn(tl.full((), BINS - 1, tl.float32), length)
    return begin - window, tl.load(edges + i + 1) - begin, scale


@triton.jit
def _add_events(
    grid, mark, dead, holding, start, stop, span, ahead, behind, along, own, wait, begin, ticks,
    scale, column, BINS: tl.constexpr, MODE: tl.constexpr,
):  # fmt: skip
    going = own
    while tl.max(going.to(tl.int32), 0) > 0:
        ends = holding & (dead <= stop)  # the reset ends
        mark = tl.where(ends, level_change_at(span, dead), mark)
        holding = holding & (dead > stop)
        now = start
        if MODE != DELETE:
            now = tl.maximum(start, dead)
        u, step = _next_crossing(span, mark, ahead, behind, now)
        going = going & (u <= stop) & (holding == 0)
        mark = tl.where(going, mark + step, mark)
        start = tl.where(going, u, start)
        fired = going & (u >= dead)
        sign = tl.where(step > 0, along, -along)
        grid = _add_to_grid(grid, fired, u, sign, begin, ticks, scale, column, BINS)
        dead = tl.where(fired, u + wait, dead)
        holding = holding | (fired & (MODE == HOLD) & (wait > 0))
    return grid, mark, dead, holding


@triton.jit
def _next_crossing(span, mark, ahead, behind, now):
    """Return time and step of the first threshold exceeded at or after `now`; NEVER if none."""
    length = span.to(tl.float32)
    u = tl.math.div_rn((mark + ahead).to(tl.float32), tl.maximum(length, 1.0))
    u = tl.where(mark + ahead > span, NEVER, tl.maximum(u, now))
    before = (mark >= behind) & ((mark - behind).to(tl.float32) >= now * length)
    return tl.where(before, now, u), tl.where(before, -behind, ahead)


@triton.jit
def _add_to_grid(grid, fired, u, sign, begin, ticks, scale, column, BINS: tl.constexpr):
    tick = tl.maximum(tl.ceil(u * ticks.to(tl.float32)).to(tl.int64) - 1, 0) + begin
    tau = tick.to(tl.float32) * scale
    b = tl.minimum(tau.to(tl.int32), BINS - 1)
    late = round_half_even((tau - b.to(tl.float32)) * 1048576.0) * (1 / 1048576.0)
    sign = tl.where(fired, sign, 0).to(tl.float32)
    grid += tl.where(column == b[:, None], (sign * (1 - late))[:, None], 0.0)
    return grid + tl.where(column == b[:, None] + 1, (sign * late)[:, None], 0.0)


@triton.jit
def draw_thresholds_and_hot_pixels(clip, keys, normals, pixel):
    mismatch, key = tl.load(clip + MISMATCH), tl.load(keys + MISMATCH_KEY)
    none = tl.full((), 0, tl.int64)
    drawn_on = random_uint32(key, none, 2 * pixel)
    drawn_off = random_uint32(key, none, 2 * pixel + 1)
    on = draw_pixel_threshold(tl.load(clip + ON), mismatch, normals, drawn_on)
    off = draw_pixel_threshold(tl.load(clip + OFF), mismatch, normals, drawn_off)
    drawn_hot = random_uint32(tl.load(keys + HOT_PIXEL_KEY), none, pixel)
    return on, off, drawn_hot.to(tl.int64) < tl.load(clip + HOT_FRACTION)


@triton.jit
def draw_pixel_threshold(threshold, mismatch, normals, drawn):
    """Return threshold * (1 + mismatch * normal), at least a quarter of the threshold."""
    cell, inside = (drawn >> 20).to(tl.int32), (drawn & 0xFFFFF).to(tl.int64)
    left, right = tl.load(normals + cell), tl.load(normals + cell + 1)
    normal = left + (((right - left) * inside) >> 20)
    spread_out = threshold + ((((threshold * mismatch) >> 20) * normal) >> 20)
    return tl.maximum(spread_out, threshold >> 2).to(tl.int32)


@triton.jit
def draw_level_minus_reference(clip, keys, pixel, on, off):
    """Return how far a reference is below the first level."""
    drawn = random_uint32(tl.load(keys + REFERENCE_KEY), tl.full((), 0, tl.int64), pixel)
    share = ((drawn >> 9).to(tl.float32) + 0.5) * (1 / 8388608.0)
    zero = load_int64_as_float64(clip + REFERENCE_ZERO)
    away = (share.to(tl.float64) - zero) * load_int64_as_float64(clip + REFERENCE_SPAN)
    return (away * tl.where(away > 0, on, off).to(tl.float64)).to(tl.int32)


@triton.jit
def is_outside(intensity):
    """Return where an intensity is not one: nan as well."""
    return ((intensity >= LOWEST) & (intensity <= HIGHEST)) == 0


@triton.jit
def fixed_point_table_position(intensity):
    """Return the place of an intensity in the tables of src.sim.sensor.response."""
    bits = intensity.to(tl.int32, bitcast=True)
    return tl.minimum(tl.maximum(bits, 0x38800000), 0x3FFFFFFF) - 0x38800000


@triton.jit
def read_table(table, position):
    left, right = tl.load(table + (position >> 13)), tl.load(table + (position >> 13) + 1)
    return (left + (((right - left) * (position & 8191)) >> 13) + 8) >> 4


@triton.jit
def apply_low_pass(decay, lag, old_level, old_source, source):
    kept = (old_level - old_source).to(tl.int64) * decay - (source - old_source).to(tl.int64) * lag
    return source + ((kept + 524288) >> 20).to(tl.int32)


@triton.jit
def level_change_at(change, fraction):
    """Return how far a level that moves by `change` in an interval has come at `fraction`."""
    return round_half_even(fraction * change.to(tl.float32)).to(tl.int32)


@triton.jit
def round_half_even(x):
    """Return `x`, not negative, rounded to the nearest whole number, halves to even."""
    return tl.where(x < 8388608.0, x + 8388608.0 - 8388608.0, x)


@triton.jit
def noise_probability(clip, hot, intensity):
    """Return the probability of a noise event in 2**-32; at white it is a quarter of black's."""
    dark = tl.load(clip + DARK_NOISE)
    seen = (tl.minimum(tl.maximum(intensity, 0.0), 1.0) * 256.0).to(tl.int64)
    return tl.where(hot, tl.load(clip + HOT_NOISE), dark - (dark >> 8) * ((3 * seen) >> 2))


@triton.jit
def draw_timed_noise_event(key, frame, pixel, probability):
    """Return time (NEVER for none) and polarity of the noise events of interval `frame`."""
    drawn, at = random_uint32(key, frame, 2 * pixel), random_uint32(key, frame, 2 * pixel + 1)
    u = ((at >> 9).to(tl.float32) + 0.5) * (1 / 8388608.0)
    return tl.where(drawn.to(tl.int64) < probability, u, NEVER), tl.where(at & 1 == 1, 1, -1)


@triton.jit
def random_uint32(key, high, low):
    """The 32 bits of src.sim.noise.bits(key, high * 2**32 + low)."""
    mixed = mix_bits(low.to(tl.uint32) ^ (key & 0xFFFFFFFF).to(tl.uint32))
    upper = high.to(tl.uint32) * 0x9E3779B9 + (key >> 32).to(tl.uint32)
    return mix_bits(mixed + upper)


@triton.jit
def mix_bits(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = (x ^ (x >> 16)) * 0x7FEB352D
    x = (x ^ (x >> 15)) * 0x846CA68B
    return x ^ (x >> 16)


@triton.jit
def load_int64_as_float64(at):
    """Return the float64 whose bits are kept as int64."""
    return tl.load(at).to(tl.float64, bitcast=True)
