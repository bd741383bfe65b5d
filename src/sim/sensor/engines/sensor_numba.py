"""The sensor's kernels for the CPU (numba), all in one file: its cache does not see other files.

Levels are integers (2**-20 nat), times are float32 fractions of the frame interval.  An event comes
at the first moment at which the pixel is not dead and the level is a threshold or more from the
reference; between frames the level moves linearly, so that each crossing costs one division.
"""

import numpy as np
from numba import njit, uint32, uint64

from src.sim.sensor.engines.job import COUNT, DELETE, HOLD, VOXELS, Memory, Scratch

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
def way(delta, u):
    """Return how far a level that moves by `delta` in an interval has come at fraction `u`."""
    return np.int64(np.rint(f32(u) * f32(delta)))


@small
def linear_events(x, l0, l1, ref, dead, on, off, wait, mode, noise_u, noise_sign, batch, count):
    """Append the events of pixel `x` to `batch`, which holds `count`; return (count, ref, dead).

    `noise_u` is the time of a noise event, above 1 for none.  All is seen along the level's way:
    `span` is its length, `at` the reference's place on it.  The function is drawn into its loop:
    the arrays of `batch` would cost more to hand over than the pixel.
    """
    who, when, sign = batch
    along = 1 if l1 >= l0 else -1
    ahead, behind = (on, off) if l1 >= l0 else (off, on)
    span, at = abs(l1 - l0), (ref - l0) * along
    start = f32(0)
    stop = min(noise_u, f32(1))
    holding = mode == HOLD and dead > start
    while True:
        if holding and dead <= stop:  # the reset ends
            at = way(span, dead)
            holding = False
        moved = False
        if not holding:
            now = start if mode == DELETE else max(start, dead)
            u, step = next_crossing(span, at, ahead, behind, now)
            if u <= stop:
                moved = True
                at += step
                start = u
                if u >= dead:
                    who[count], when[count], sign[count] = x, u, along if step > 0 else -along
                    count += 1
                    dead = u + wait
                    holding = mode == HOLD and wait > 0
        if moved:
            continue
        if stop != noise_u:
            return count, l0 + at * along, dead
        if noise_u >= dead:
            who[count], when[count], sign[count] = x, noise_u, noise_sign
            count += 1
            at = way(span, noise_u)
            dead = noise_u + wait
            holding = mode == HOLD and wait > 0
        start, stop, noise_u = noise_u, f32(1), f32(2)


@small
def next_crossing(span, at, ahead, behind, now):
    """Return time and step of the first threshold exceeded at or after `now`; time 2 if none."""
    if at >= behind and f32(at - behind) >= now * f32(span):  # exceeded before, and still so
        return now, -behind
    if at + ahead > span:
        return f32(2), ahead
    u = f32(at + ahead) / f32(span)
    return (u if u > now else now), ahead  # now, if it was exceeded before: also at 0 / 0


@small
def v2e_crossings(l0, l1, ref, dead, on, off, mode):
    """Return (thresholds between the reference and the frame's level, reference)."""
    if mode == HOLD and dead > 1:
        return 0, ref
    if mode == HOLD and dead > 0:
        ref = l0 + way(l1 - l0, dead)
    return (l1 - ref) // on if l1 >= ref else (ref - l1) // off, ref


@small
def v2e_events(x, l0, l1, ref, dead, on, off, wait, mode, steps, noise_u, noise_sign, batch, count):
    """The same with v2e's time stamps: `steps` for the whole view, set by its busiest pixel.

    The pixel's first crossings take the first stamps; a stamp within the dead time is refused
    (compute_events of v2e's emulator).  Where a stamp interval is longer than the refractory
    period, v2e neither tests nor records it.  Noise is stamped at the end of the interval.
    """
    who, when, sign = batch
    tested = wait * f32(steps) > 1
    crossings, ref = v2e_crossings(l0, l1, ref, dead, on, off, mode)
    for i in range(1, crossings + 1):
        stamp = f32(i) / f32(steps)
        s = 1 if l1 - ref >= on else (-1 if ref - l1 >= off else 0)
        if s == 0:
            break
        kept = not tested or stamp > dead
        if kept:
            who[count], when[count], sign[count] = x, stamp, s
            count += 1
            if tested:
                dead = stamp + wait
        if kept or mode == DELETE:
            ref += on if s > 0 else -off
        if kept and tested and mode == HOLD:
            if dead > 1:
                break
            ref = l0 + way(l1 - l0, dead)
    if noise_u <= 1:
        who[count], when[count], sign[count] = x, f32(1), noise_sign
        count += 1
        ref = l1
    return count, ref, dead


@small
def place_of(intensity_bits):
    """Return the place in the tables of an intensity, given by the bits of its float."""
    return np.int64(min(max(intensity_bits, 0x38800000), 0x3FFFFFFF) - 0x38800000)


@small
def look(table, place):
    """Return the table's value at one place, as src.sim.sensor.response.lookup does."""
    cell, inside = place >> 13, place & 8191
    left = table[cell]
    return (left + (((table[cell + 1] - left) * inside) >> 13) + 8) >> 4


@kernel
def read_levels(table, intensity, levels):
    """Fill `levels` with a frame's levels before the low-pass."""
    places = intensity.view(np.int32)
    for x in range(places.size):
        levels[x] = look(table, place_of(places[x]))


@kernel
def low_pass(decay, lag, intensity, memory, level):
    """Filter the new frame's levels in place; the memory's are those of the frame before."""
    places, old_source, old_level = intensity.view(np.int32), memory.source, memory.level
    for x in range(places.size):
        place, source = place_of(places[x]), level[x]
        old = np.int64(old_level[x] - old_source[x]) * look(decay, place)
        old -= np.int64(source - old_source[x]) * look(lag, place)
        level[x], old_source[x] = source + ((old + 524288) >> 20), source


@kernel
def make_chip(chip, c, v, first, scratch):
    """Fill what the pixels of a unit are, whatever they see, from pixel `first` of the crop on."""
    on, off, hot, pixel = scratch.on, scratch.off, scratch.hot, scratch.pixel
    threshold_on, threshold_off, spread, hot_share = chip.chips[c]
    mismatch_key, hot_key, normals = chip.chip_keys[v, 0], chip.chip_keys[v, 1], chip.normals
    top, left, full_width, width = chip.place
    for x in range(on.size):
        y = (first + x) // width
        at = (top + y) * full_width + left + first + x - y * width
        pixel[x], on[x], off[x], hot[x] = at, threshold_on, threshold_off, False
        if spread > 0:
            on[x] = spread_threshold(threshold_on, spread, normals, bits(mismatch_key, 0, 2 * at))
            off[x] = spread_threshold(
                threshold_off, spread, normals, bits(mismatch_key, 0, 2 * at + 1)
            )
        if hot_share > 0:
            hot[x] = bits(hot_key, 0, at) < hot_share


@small
def spread_threshold(threshold, spread, normals, drawn):
    """Return threshold * (1 + spread * normal), at least a quarter of the threshold."""
    cell, inside = np.int64(drawn >> uint32(20)), np.int64(drawn & uint32(0xFFFFF))
    normal = normals[cell] + (((normals[cell + 1] - normals[cell]) * inside) >> 20)
    return max(threshold + ((((threshold * spread) >> 20) * normal) >> 20), threshold >> 2)


@kernel
def draw_noise(chip, scratch, key, frame, intensity):
    """Fill times and polarities of the noise events of interval `frame`; time 2 for none.

    `chip.shot` is their probability at black in 2**-32; at white it is a quarter (v2e).
    """
    pixel, hot, shot, hot_rate = scratch.pixel, scratch.hot, chip.shot, chip.hot
    noise_u, noise_sign = scratch.noise_u, scratch.noise_sign
    for x in range(intensity.size):
        seen = np.int64(min(max(intensity[x], f32(0)), f32(1)) * f32(256))
        rate = hot_rate if hot[x] else shot - (shot >> 8) * ((3 * seen) >> 2)
        at = bits(key, frame, 2 * pixel[x] + 1)
        u = (f32(at >> uint32(9)) + f32(0.5)) * f32(2.0**-23)
        noise_u[x] = u if np.int64(bits(key, frame, 2 * pixel[x])) < rate else f32(2)
        noise_sign[x] = 1 if at & uint32(1) else -1


@kernel
def draw_leak(leak, scratch, frame):
    """Fill how far the references leak in interval `frame`, by the whole units leaked so far."""
    on, drift = scratch.on, scratch.drift
    for x in range(on.size):
        rate = np.int64(on[x]) * leak
        drift[x] = ((rate * (frame + 1)) >> 24) - ((rate * frame) >> 24)


@kernel
def busiest(mode, memory, scratch):
    """Return the largest number of crossings of any pixel of a unit, at least 1."""
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift, on, off = scratch.level, scratch.drift, scratch.on, scratch.off
    steps = np.int64(1)
    for x in range(level.size):
        l1, ref, up, down = np.int64(new[x]) + drift[x], np.int64(reference[x]), on[x], off[x]
        more = (l1 - ref >= (steps + 1) * up) | (ref - l1 >= (steps + 1) * down)
        if more | (mode == HOLD and dead[x] > 0):  # else a division for nothing
            crossings, _ = v2e_crossings(np.int64(level[x]), l1, ref, dead[x], up, down, mode)
            steps = max(steps, crossings)
    return steps


@kernel
def find_active(mode, memory, scratch):
    """List the pixels that have something to do in `scratch.active`; return how many.

    Without a branch per pixel: which are quiet is not predictable.  But eight in a row often are.
    """
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift, on, off = scratch.level, scratch.drift, scratch.on, scratch.off
    active, busy, noise_u = scratch.active, scratch.busy, scratch.noise_u
    holds, count = mode == HOLD, 0
    for x in range(level.size):
        l0, l1, ref = level[x], np.int32(new[x] + drift[x]), reference[x]
        reached = (max(l0, l1) - ref >= on[x]) | (ref - min(l0, l1) >= off[x])
        busy[x] = reached | (noise_u[x] <= 1) | (holds & (dead[x] > 0))
    eights = busy.view(np.uint64)
    for i in range(eights.size):
        if eights[i]:
            for x in range(8 * i, 8 * i + 8):
                active[count] = x
                count += busy[x]
    return count


@kernel
def find_events(chip, memory, scratch, steps, done, last):
    """Take the active pixels `done` .. `last` - 1 through an interval, until the batch is full.

    Returns the number of events in the batch and of the pixels that are done.
    """
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift, on_, off_ = scratch.level, scratch.drift, scratch.on, scratch.off
    active, noise_u, noise_sign = scratch.active, scratch.noise_u, scratch.noise_sign
    batch = scratch.who, scratch.when, scratch.sign
    wait, mode, v2e, count = chip.wait, chip.mode, chip.v2e, 0
    while done < last and count <= level.size:
        x = active[done]
        on, off = np.int64(on_[x]), np.int64(off_[x])
        l0, l1, ref = np.int64(level[x]), np.int64(new[x]) + drift[x], np.int64(reference[x])
        u, s = noise_u[x], np.int64(noise_sign[x])
        if v2e:
            count, ref, dead[x] = v2e_events(
                x, l0, l1, ref, dead[x], on, off, wait, mode, steps, u, s, batch, count
            )
        else:
            count, ref, dead[x] = linear_events(
                x, l0, l1, ref, dead[x], on, off, wait, mode, u, s, batch, count
            )
        reference[x] = ref
        done += 1
    return count, done


@kernel
def deliver(sink, place, scratch, number, clock):
    """Bring the first `number` events of the batch to where they go; `place` is the unit's."""
    unit, c, v, first, width = place
    who, when, sign = scratch.who, scratch.when, scratch.sign
    counts, offsets, events = sink.counts, sink.offsets, sink.events
    if sink.output == VOXELS:
        add_to_grid(sink.voxels[c, v, clock[0], :, first:], who, when, sign, number, clock)
    elif sink.output == COUNT:
        for i in range(number):
            counts[unit, 0 if sign[i] > 0 else 1] += 1
    else:
        for i in range(number):
            at, pixel = offsets[unit] + i, first + who[i]
            events[at].t, events[at].p = stamp(when[i], clock), sign[i]
            events[at].x, events[at].y = pixel % width, pixel // width
        offsets[unit] += number


@kernel
def add_to_grid(grid, who, when, sign, number, clock):
    """Add events to a unit's grid (bins, pixels), bilinear in time."""
    origin, scale, bins = clock[1], clock[2], grid.shape[0]
    for i in range(number):
        tau = f32(f32(stamp(when[i], clock) - origin) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        grid[b, who[i]] += f32(sign[i]) * (f32(1) - late)
        if late > 0 and b + 1 < bins:
            grid[b + 1, who[i]] += f32(sign[i]) * late


@small
def stamp(u, clock):
    """Return the tick of the sensor's clock in which fraction `u` of the interval falls."""
    return clock[3] + max(np.int64(np.ceil(u * f32(clock[4] - clock[3]))) - 1, 0)


@kernel
def start(table, intensity, memory):
    """Set the memory to the first frame."""
    read_levels(table, intensity, memory.level)
    memory.source[:] = memory.level
    memory.reference[:] = memory.level
    memory.dead[:] = f32(0)


@kernel
def advance(chip, memory, scratch, sink, place, clock):
    """Take one unit through one interval, at whose end the levels are those of the scratch."""
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift = scratch.level, scratch.drift
    steps = busiest(chip.mode, memory, scratch) if chip.v2e else np.int64(1)
    done, last = 0, find_active(chip.mode, memory, scratch)
    while done < last:
        number, done = find_events(chip, memory, scratch, steps, done, last)
        deliver(sink, place, scratch, number, clock)
    for x in range(level.size):
        reference[x] -= drift[x]
        level[x], dead[x] = new[x], max(dead[x] - f32(1), f32(0))


@kernel
def see(chip, memory, scratch, intensity, key, frame):
    """Fill the scratch with what interval `frame` brings: levels at its end, noise and leak."""
    read_levels(chip.tables[0], intensity, scratch.level)
    if chip.tables[1].size > 1:
        low_pass(chip.tables[1], chip.tables[2], intensity, memory, scratch.level)
    if chip.shot or chip.hot:
        draw_noise(chip, scratch, key, frame, intensity)
    if chip.leak:
        draw_leak(chip.leak, scratch, frame)


@kernel
def clock_at(edges, i, substeps, bins):
    """Return interval `i`'s window, the window's start and bins per microsecond, both edges."""
    window = i // substeps
    origin, end = edges[window * substeps], edges[(window + 1) * substeps]
    return window, origin, f32(f32(bins - 1) / f32(end - origin)), edges[i], edges[i + 1]


@kernel
def make_scratch(size, smallest):
    """Return the scratch; a pixel has no more events in an interval than thresholds in 32 nat."""
    whole, room = (size + 7) // 8 * 8, size + 32 + (1 << 25) // max(smallest >> 2, 1024)
    return Scratch(
        np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32),
        np.empty(size, np.bool_), np.zeros(size, np.int32), np.empty(size, np.int32),
        np.empty(whole + 1, np.uint32), np.zeros(whole, np.uint8),
        np.full(size, f32(2)), np.ones(size, np.int8),
        np.empty(room, np.uint32), np.empty(room, np.float32), np.empty(room, np.int8),
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def simulate(
    first_unit, last_unit, size, frames, fresh, chip, memory, edges, first, substeps, sink
):
    """Simulate units first_unit .. last_unit - 1: `size` consecutive pixels of a view each."""
    _, views, samples, pixels = frames.shape
    units = (pixels + size - 1) // size
    for unit in range(first_unit, last_unit):
        c, v, a = unit // (views * units), unit // units % views, unit % units * size
        b = min(a + size, pixels)
        own = Memory(
            memory.level[c, v, a:b], memory.source[c, v, a:b],
            memory.reference[c, v, a:b], memory.dead[c, v, a:b],
        )  # fmt: skip
        scratch = make_scratch(b - a, chip.chips[:, :2].min())
        make_chip(chip, c, v, a, scratch)
        if fresh:
            start(chip.tables[0], frames[c, v, 0, a:b], own)
        for i in range(samples - fresh):
            clock = clock_at(edges, i, substeps, sink.voxels.shape[3])
            if sink.output == VOXELS and i % substeps == 0:
                sink.voxels[c, v, clock[0], :, a:b] = f32(0)
            see(chip, own, scratch, frames[c, v, i + fresh, a:b], chip.shot_keys[c, v], first + i)
            advance(chip, own, scratch, sink, (unit, c, v, a, chip.place[3]), clock)
        if chip.tables[1].size == 1:
            own.source[:] = own.level
