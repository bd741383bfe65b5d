"""The sensor's kernels for the CPU (numba), all in one file: its cache does not see other files.

Levels are integers (2**-20 nat), times are float32 fractions of the frame interval.  An event comes
at the first moment at which the pixel is not dead and the level is a threshold or more from the
reference; between frames the level moves linearly, so that each crossing costs one division.
"""

import numpy as np
from numba import njit, uint32, uint64

from src.sim.engines.job import COUNT, DELETE, HOLD, VOXELS, Scratch

f32 = np.float32
kernel = njit(nogil=True, error_model="numpy")  # no test for a zero divisor
small = njit(nogil=True, error_model="numpy", inline="always")


@small
def mix(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = uint32(x)
    x ^= x >> uint32(16)
    x = uint32(x * uint32(0x7FEB352D))
    x ^= x >> uint32(15)
    x = uint32(x * uint32(0x846CA68B))
    return uint32(x ^ (x >> uint32(16)))


@small
def bits(key, high, low):
    """src.sim.noise.bits(key, high * 2**32 + low), the same 32 bits."""
    mixed = mix(uint32(low) ^ uint32(uint64(key) & uint64(0xFFFFFFFF)))
    upper = uint32(uint64(key) >> uint64(32))
    return mix(uint32(mixed + uint32(uint32(high) * uint32(0x9E3779B9)) + upper))


@small
def level_at(start, delta, u):
    """Return the level at fraction `u` of an interval that begins at `start`."""
    return start + np.int64(np.rint(f32(u) * f32(delta)))


@kernel
def linear_events(l0, l1, ref, dead, on, off, wait, mode, noise_u, noise_sign, when, sign):
    """Return (events, ref, dead); `noise_u` is the time of a noise event, above 1 for none."""
    delta = l1 - l0
    count = 0
    start = f32(0)
    stop = min(noise_u, f32(1))
    holding = mode == HOLD and dead > start
    while True:
        if holding and dead <= stop:  # the reset ends
            ref = level_at(l0, delta, dead)
            holding = False
        moved = False
        if not holding:
            now = start if mode == DELETE else max(start, dead)
            u, s = next_crossing(l0, delta, ref, on, off, now)
            if u <= stop:
                moved = True
                ref += on if s > 0 else -off
                start = u
                if u >= dead:
                    when[count] = u
                    sign[count] = s
                    count += 1
                    dead = u + wait
                    holding = mode == HOLD and wait > 0
        if moved:
            continue
        if stop != noise_u:
            return count, ref, dead
        if noise_u >= dead:
            when[count] = noise_u
            sign[count] = noise_sign
            count += 1
            ref = level_at(l0, delta, noise_u)
            dead = noise_u + wait
            holding = mode == HOLD and wait > 0
        start, stop, noise_u = noise_u, f32(1), f32(2)


@small
def next_crossing(l0, delta, ref, on, off, now):
    """Return (time, polarity) of the first threshold exceeded at or after `now`; time 2 if none."""
    if delta >= 0:
        ahead, behind, span, s = ref + on - l0, ref - off - l0, delta, 1
    else:
        ahead, behind, span, s = l0 - ref + off, l0 - ref - on, -delta, -1
    if behind >= 0 and f32(behind) >= now * f32(span):  # exceeded before, and still so
        return now, -s
    if ahead > span:
        return f32(2), s
    if ahead <= 0:
        return now, s
    u = f32(ahead) / f32(span)
    return (u if u > now else now), s


@kernel
def v2e_crossings(l0, l1, ref, dead, on, off, mode):
    """Return (thresholds between the reference and the frame's level, reference)."""
    if mode == HOLD and dead > 1:
        return 0, ref
    if mode == HOLD and dead > 0:
        ref = level_at(l0, l1 - l0, dead)
    return (l1 - ref) // on if l1 >= ref else (ref - l1) // off, ref


@kernel
def v2e_events(l0, l1, ref, dead, on, off, wait, mode, steps, noise_u, noise_sign, when, sign):
    """The same with v2e's time stamps: `steps` for the whole frame, set by its busiest pixel.

    The pixel's first crossings take the first stamps; a stamp within the dead time is refused
    (compute_events of v2e's emulator).  Where a stamp interval is longer than the refractory
    period, v2e neither tests nor records it.  Noise is stamped at the end of the interval.
    """
    count = 0
    tested = wait * f32(steps) > 1
    crossings, ref = v2e_crossings(l0, l1, ref, dead, on, off, mode)
    for i in range(1, crossings + 1):
        stamp = f32(i) / f32(steps)
        s = 1 if l1 - ref >= on else (-1 if ref - l1 >= off else 0)
        if s == 0:
            break
        kept = not tested or stamp > dead
        if kept:
            when[count] = stamp
            sign[count] = s
            count += 1
            if tested:
                dead = stamp + wait
        if kept or mode == DELETE:
            ref += on if s > 0 else -off
        if kept and tested and mode == HOLD:
            if dead > 1:
                break
            ref = level_at(l0, l1 - l0, dead)
    if noise_u <= 1:
        when[count] = f32(1)
        sign[count] = noise_sign
        count += 1
        ref = l1
    return count, ref, dead


@small
def look(table, place, shift):
    """Return the table's value at the bits of one intensity, as src.sim.response.lookup does."""
    cell, inside = place >> 13, place & 8191
    left = table[cell]
    return (left + (((table[cell + 1] - left) * inside) >> 13) + (1 << (shift - 1))) >> shift


@kernel
def make_row(chip, normals, keys, pixel, on, off, hot):
    """Fill one row of thresholds `on`, `off` and of `hot`: what the chip is, whatever it sees."""
    threshold_on, threshold_off, spread, hot_share = chip
    for x in range(on.size):
        on[x], off[x], hot[x] = threshold_on, threshold_off, False
        at = pixel + x
        if spread > 0:
            on[x] = spread_threshold(threshold_on, spread, normals, bits(keys[0], 0, 2 * at))
            off[x] = spread_threshold(threshold_off, spread, normals, bits(keys[0], 0, 2 * at + 1))
        if hot_share > 0:
            hot[x] = bits(keys[1], 0, at) < hot_share


@small
def spread_threshold(threshold, spread, normals, drawn):
    """Return threshold * (1 + spread * normal), at least a quarter of the threshold."""
    cell, inside = np.int64(drawn >> uint32(20)), np.int64(drawn & uint32(0xFFFFF))
    normal = normals[cell] + (((normals[cell + 1] - normals[cell]) * inside) >> 20)
    return max(threshold + ((((threshold * spread) >> 20) * normal) >> 20), threshold >> 2)


@kernel
def new_levels(frame, table, decay, ramp, source, level, new_source, new_level):
    """Fill one row with the levels of a frame, before and after the low-pass if there is one."""
    places = frame.view(np.int32)
    for x in range(frame.size):
        place = np.int64(min(max(places[x], 0x38800000), 0x3FFFFFFF) - 0x38800000)
        y = look(table, place, 4)
        new_source[x], new_level[x] = y, y
        if decay.size > 1:
            keep, lag = look(decay, place, 4), look(ramp, place, 4)
            old = np.int64(level[x] - source[x]) * keep - np.int64(y - source[x]) * lag
            new_level[x] = y + ((old + 524288) >> 20)


@small
def noise_event(key, frame, pixel, intensity, shot):
    """Return (time, polarity) of the noise event of a pixel and interval; time 2 for none.

    `shot` is its probability at black in 2**-32; at white it is a quarter (v2e).
    """
    seen = np.int64(min(max(intensity, f32(0)), f32(1)) * f32(256))
    drawn = bits(key, frame, 2 * pixel)
    if np.int64(drawn) >= shot - (shot >> 8) * ((3 * seen) >> 2):
        return f32(2), 1
    at = bits(key, frame, 2 * pixel + 1)
    return (f32(at >> uint32(9)) + f32(0.5)) * f32(2.0**-23), 1 if at & uint32(1) else -1


@small
def leaked(leak, threshold, frame):
    """Return how far the reference leaks in interval `frame`, by its whole units so far."""
    rate = np.int64(threshold) * leak
    return ((rate * (frame + 1)) >> 24) - ((rate * frame) >> 24)


@small
def add_to_grid(grid, x, ticks, scale, sign):
    """Add one event `ticks` microseconds into the window to one row's `grid` (bins, w)."""
    bins = grid.shape[0]
    tau = f32(f32(ticks) * scale)
    b = min(np.int64(tau), bins - 1)
    late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
    grid[b, x] += f32(sign) * (f32(1) - late)
    if late > 0 and b + 1 < bins:
        grid[b + 1, x] += f32(sign) * late


@kernel
def busiest(chip, memory, scratch, c, v, frame):
    """Return the largest number of crossings of any pixel of a view, at least 1."""
    steps = np.int64(1)
    for y in range(scratch.on.shape[0]):
        for x in range(scratch.on.shape[1]):
            on, off = np.int64(scratch.on[y, x]), np.int64(scratch.off[y, x])
            crossings, _ = v2e_crossings(
                np.int64(memory.level[c, v, y, x]),
                scratch.level[y, x] + leaked(chip.leak, on, frame),
                np.int64(memory.reference[c, v, y, x]),
                memory.dead[c, v, y, x], on, off, chip.mode,
            )  # fmt: skip
            steps = max(steps, crossings)
    return steps


@kernel
def find_active(chip, scratch, r, level, reference, dead, frame):
    """List the pixels of a row that have something to do in `scratch.active`; return how many.

    Without a branch: most pixels are quiet in most intervals, and which are is not predictable.
    """
    new, on, off = scratch.level[r], scratch.on[r], scratch.off[r]
    active, noise_u, busy = scratch.active, scratch.noise_u, scratch.busy
    leak, holds, count = chip.leak, chip.mode == HOLD, 0
    for x in range(level.size):
        l0, l1, ref = level[x], new[x], reference[x]
        if leak:
            l1 += np.int32(leaked(leak, on[x], frame))
        reached = (max(l0, l1) - ref >= on[x]) | (ref - min(l0, l1) >= off[x])
        busy[x] = reached | (noise_u[x] <= 1) | (holds & (dead[x] > 0))
    for x in range(level.size):
        active[count] = x
        count += busy[x]
    return count


@kernel
def draw_noise(chip, scratch, r, c, v, pixel, frame, intensity):
    """Fill the row's times and polarities of noise events; time 2 for none."""
    key, hot, shot, hot_rate = chip.shot_keys[c, v], scratch.hot[r], chip.shot, chip.hot
    noise_u, noise_sign = scratch.noise_u, scratch.noise_sign
    for x in range(intensity.size):
        u, s = f32(2), 1
        if hot[x]:
            u, s = noise_event(key, frame, pixel + x, f32(0), hot_rate)
        elif shot:
            u, s = noise_event(key, frame, pixel + x, intensity[x], shot)
        noise_u[x], noise_sign[x] = u, s


@kernel
def advance(chip, memory, sink, scratch, intensity, where, frame, steps, clock):
    """Take one row through one interval; `clock`: window, its start and scale, interval's edges.

    Arrays are taken out of their tuples before the loops: in a loop each would be counted as a
    reference, which costs more than the pixel.
    """
    c, v, y, r = where
    level, reference = memory.level[c, v, y], memory.reference[c, v, y]
    dead, new = memory.dead[c, v, y], scratch.level[r]
    on_row, off_row = scratch.on[r], scratch.off[r]
    active, noise_u, noise_sign = scratch.active, scratch.noise_u, scratch.noise_sign
    when, sign, leak, wait, mode = scratch.when, scratch.sign, chip.leak, chip.wait, chip.mode
    if chip.shot or chip.hot:
        pixel = (chip.place[0] + y) * chip.place[2] + chip.place[1]
        draw_noise(chip, scratch, r, c, v, pixel, frame, intensity)
    row = (c * sink.voxels.shape[1] + v) * sink.voxels.shape[4] + y
    grid = sink.voxels[c, v, min(clock[0], sink.voxels.shape[2] - 1), :, y]
    counts, offsets, events = sink.counts, sink.offsets, sink.events
    for k in range(find_active(chip, scratch, r, level, reference, dead, frame)):
        x = active[k]
        on, off = np.int64(on_row[x]), np.int64(off_row[x])
        drift = leaked(leak, on, frame) if leak else np.int64(0)
        l0, l1, ref = np.int64(level[x]), new[x] + drift, np.int64(reference[x])
        u, s = noise_u[x], np.int64(noise_sign[x])
        if chip.v2e:
            count, ref, dead[x] = v2e_events(
                l0, l1, ref, dead[x], on, off, wait, mode, steps, u, s, when, sign
            )
        else:
            count, ref, dead[x] = linear_events(
                l0, l1, ref, dead[x], on, off, wait, mode, u, s, when, sign
            )
        reference[x] = ref
        for i in range(count):
            t = stamp(when[i], clock)
            if sink.output == VOXELS:
                add_to_grid(grid, x, t - clock[1], clock[2], sign[i])
            elif sink.output == COUNT:
                counts[row, 0 if sign[i] > 0 else 1] += 1
            else:
                at = offsets[row]
                events[at].t, events[at].x, events[at].y, events[at].p = t, x, y, sign[i]
                offsets[row] = at + 1
    for x in range(level.size):
        if leak:
            reference[x] -= np.int32(leaked(leak, on_row[x], frame))
        level[x], dead[x] = new[x], max(dead[x] - f32(1), f32(0))
    memory.source[c, v, y] = scratch.source[r]


@small
def stamp(u, clock):
    """Return the tick of the sensor's clock in which fraction `u` of the interval falls."""
    return clock[3] + max(np.int64(np.ceil(u * f32(clock[4] - clock[3]))) - 1, 0)


@kernel
def make_scratch(rows, width, smallest):
    """Return the scratch; a pixel has no more events in an interval than thresholds in 32 nat."""
    room = 32 + (1 << 25) // max(smallest >> 2, 1024)
    return Scratch(
        np.empty((rows, width), np.int32), np.empty((rows, width), np.int32),
        np.empty((rows, width), np.bool_), np.empty((rows, width), np.int32),
        np.empty((rows, width), np.int32), np.empty(width + 1, np.int64), np.empty(width, np.uint8),
        np.full(width, f32(2)), np.ones(width, np.int8),
        np.empty(room, np.float32), np.empty(room, np.int8),
    )  # fmt: skip


@kernel
def begin(chip, memory, scratch, frame, where, fresh):
    """Set up one row: its pixels, and if it is fresh the memory of the first frame."""
    c, v, y, r = where
    pixel = (chip.place[0] + y) * chip.place[2] + chip.place[1]
    row = (chip.chips[c, 0], chip.chips[c, 1], chip.chips[c, 2], chip.chips[c, 3])
    make_row(
        row, chip.normals, chip.chip_keys[v], pixel, scratch.on[r], scratch.off[r], scratch.hot[r]
    )
    if fresh:
        table, level = chip.tables[0], memory.level[c, v, y]
        new_levels(frame, table, table[:1], table[:1], level, level, level, level)
        memory.source[c, v, y] = level
        memory.reference[c, v, y] = level
        memory.dead[c, v, y] = f32(0)


@njit(nogil=True, cache=True, error_model="numpy")
def simulate(first_unit, last_unit, frames, fresh, chip, memory, edges, first, substeps, sink):
    """Simulate units first_unit .. last_unit - 1: one row of a view each, with v2e's stamps all."""
    _, views, samples, height, width = frames.shape
    bins = sink.voxels.shape[3]
    rows = height if chip.v2e else 1
    units = height // rows
    scratch = make_scratch(rows, width, chip.chips[:, :2].min())
    for unit in range(first_unit, last_unit):
        c, v, y0 = unit // (views * units), unit // units % views, unit % units * rows
        for r in range(rows):
            begin(chip, memory, scratch, frames[c, v, 0, y0 + r], (c, v, y0 + r, r), fresh)
        for i in range(samples - fresh):
            for r in range(rows):
                new_levels(
                    frames[c, v, i + fresh, y0 + r], chip.tables[0], chip.tables[1],
                    chip.tables[2], memory.source[c, v, y0 + r], memory.level[c, v, y0 + r],
                    scratch.source[r], scratch.level[r],
                )  # fmt: skip
            steps = np.int64(1)
            if chip.v2e:
                steps = busiest(chip, memory, scratch, c, v, first + i)
            window = i // substeps
            origin, end = edges[window * substeps], edges[(window + 1) * substeps]
            clock = (window, origin, f32(f32(bins - 1) / f32(end - origin)), edges[i], edges[i + 1])
            for r in range(rows):
                if sink.output == VOXELS and i % substeps == 0:
                    sink.voxels[c, v, window, :, y0 + r, :] = f32(0)
                advance(
                    chip, memory, sink, scratch, frames[c, v, i + fresh, y0 + r],
                    (c, v, y0 + r, r), first + i, steps, clock,
                )  # fmt: skip
