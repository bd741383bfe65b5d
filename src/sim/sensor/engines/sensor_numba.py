"""The sensor's kernels for the CPU (numba), all in one file: its cache does not see other files.

Levels are integers (2**-20 nat), times are float32 fractions of the frame interval.  An event comes
at the first moment at which the pixel is not dead and the level is a threshold or more from the
reference; between frames the level moves linearly, so that each crossing costs one division.
"""

import numpy as np
from numba import njit, uint32, uint64

from src.sim.sensor.engines import job
from src.sim.sensor.engines.job import COUNT, DELETE, HOLD, VOXELS, Memory, Scratch

f32, i32 = np.float32, np.int32
DARKEST, BRIGHTEST, WHITE = 0x38800000, 0x3FFFFFFF, 0x3F800000  # bits of 2**-14, of below 2, of 1
DARKEST_HALF, BRIGHTEST_HALF, WHITE_HALF = 0x0400, 0x4000, 0x3C00  # of float16
MISMATCH, HOT, SHOT, RESIDUAL = job.MISMATCH_KEY, job.HOT_KEY, job.SHOT_KEY, job.RESIDUAL_KEY
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
    return i32(min(max(i32(intensity_bits), i32(DARKEST)), i32(BRIGHTEST)) - i32(DARKEST))


@small
def look(table, place):
    """Return the table's value at one place, as src.sim.sensor.response.lookup does."""
    cell, inside = uint32(place) >> uint32(13), i32(place & i32(8191))
    left = table[cell]
    part = i32(i32(table[cell + uint32(1)] - left) * inside) >> i32(13)
    return i32(i32(left + i32(part) + i32(8)) >> i32(4))


@kernel
def read_levels(table, intensity, levels):
    """Fill `levels` with a frame's levels before the low-pass; return whether any light is negative
    or above 1: the bits of such floats are the larger numbers.
    """
    places, most = intensity.view(np.uint32), uint32(0)
    for x in range(places.size):
        most = max(most, places[x])
        levels[x] = look(table, place_of(places[x]))
    return most > WHITE


@kernel
def read_halves(table, halves, intensity, levels):
    """The same of the bits of float16, whose lights are the table's nodes; widened in `intensity`.

    In a float32's place the exponent is too small by 127 - 15: exact also for light below 2**-14.
    """
    places, most = intensity.view(np.uint32), uint32(0)
    for x in range(places.size):
        half, unsigned = i32(halves[x]), uint32(halves[x]) & uint32(0xFFFF)
        most = max(most, uint32(unsigned))
        node = min(max(half, i32(DARKEST_HALF)), i32(BRIGHTEST_HALF)) - i32(DARKEST_HALF)
        levels[x] = i32(i32(table[uint32(node)] + i32(8)) >> i32(4))
        sign = uint32(unsigned & uint32(0x8000)) << uint32(16)
        places[x] = uint32(uint32(unsigned & uint32(0x7FFF)) << uint32(13)) | uint32(sign)
    for x in range(places.size):
        intensity[x] *= f32(2.0**112)
    return most > WHITE_HALF


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
def number_pixels(clip, width, first, pixel):
    """Fill the numbers that the pixels of a unit have in the whole frame."""
    row, column = first // width, first % width
    at = (clip.top + row) * clip.full_width + clip.left + column
    for x in range(pixel.size):
        pixel[x] = at
        at, column = at + 1, column + 1
        if column == width:
            at, column = at + clip.full_width - width, 0


@kernel
def make_chip(clip, keys, normals, scratch):
    """Fill what the pixels of a unit are, whatever they see; return how many are hot."""
    on, off, hot, pixel, drawn = scratch.on, scratch.off, scratch.hot, scratch.pixel, scratch.drawn
    on[:], off[:], hots = clip.on, clip.off, 0
    if clip.spread > 0:
        draw_bits(keys[MISMATCH], 2, 0, pixel, drawn)
        spread_thresholds(clip.on, clip.spread, normals, drawn, on)
        draw_bits(keys[MISMATCH], 2, 1, pixel, drawn)
        spread_thresholds(clip.off, clip.spread, normals, drawn, off)
    if clip.hot_share > 0:
        draw_bits(keys[HOT], 1, 0, pixel, drawn)
        for x in range(pixel.size):
            if drawn[x] < clip.hot_share:
                hot[hots] = x
                hots += 1
    return hots


@kernel
def draw_bits(key, each, word, pixel, drawn):
    """Fill bits(key, 0, each * pixel + word): a pixel has `each` words of random bits."""
    for x in range(pixel.size):
        drawn[x] = bits(key, 0, uint32(each) * uint32(pixel[x]) + uint32(word))


@kernel
def spread_thresholds(threshold, spread, normals, drawn, out):
    """Fill threshold * (1 + spread * normal), at least a quarter of the threshold."""
    deviation, least = (threshold * spread) >> 20, threshold >> 2
    for x in range(drawn.size):
        cell, inside = drawn[x] >> uint32(20), np.int64(drawn[x] & uint32(0xFFFFF))
        left = normals[cell]
        normal = left + (((normals[cell + uint32(1)] - left) * inside) >> 20)
        out[x] = max(threshold + ((deviation * normal) >> 20), least)


@kernel
def mix_pixels(key, pixel, mixed):
    """Fill the part of bits(key, frame, 2 * pixel) that is the same in all frames."""
    low = uint32(uint64(key) & uint64(0xFFFFFFFF))
    for x in range(pixel.size):
        mixed[x] = mix(uint32(2) * uint32(pixel[x]) ^ low)


@kernel
def mark_noise(clip, hots, scratch, key, frame, intensity):
    """Mark the pixels with a noise event in interval `frame`.

    `clip.shot` is its probability at black in 2**-32; at white it is a quarter (v2e).
    """
    mixed, noisy = scratch.mixed, scratch.noisy
    upper = uint32(uint64(key) >> uint64(32)) + uint32(uint32(frame) * uint32(0x9E3779B9))
    most, slope = uint32(clip.shot - 1), uint32(clip.shot >> 8)
    if clip.shot > 0:  # then the probability is nowhere 0, and `most` one below it
        for x in range(intensity.size):
            seen = uint32(i32(min(max(intensity[x], f32(0)), f32(1)) * f32(256)))
            rate = uint32(most - uint32(slope * uint32(uint32(uint32(3) * seen) >> uint32(2))))
            noisy[x] = mix(uint32(mixed[x] + upper)) <= rate
    for x in scratch.hot[:hots]:
        noisy[x] = mix(uint32(mixed[x] + upper)) < clip.hot


@kernel
def draw_noise(scratch, key, frame, last):
    """Fill times and polarities of the noise events of the active pixels; time 2 for none."""
    pixel, noisy, active = scratch.pixel, scratch.noisy, scratch.active
    noise_u, noise_sign = scratch.noise_u, scratch.noise_sign
    for x in active[:last]:
        at = bits(key, frame, uint32(2) * uint32(pixel[x]) + uint32(1))
        u = (f32(at >> uint32(9)) + f32(0.5)) * f32(2.0**-23)
        noise_u[x] = u if noisy[x] else f32(2)
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
    active, busy, noisy = scratch.active, scratch.busy, scratch.noisy
    for x in range(level.size):
        l0, l1, ref = level[x], np.int32(new[x] + drift[x]), reference[x]
        up, down = np.int32(max(l0, l1) - ref), np.int32(ref - min(l0, l1))
        busy[x] = (up >= on[x]) | (down >= off[x]) | noisy[x]
    if mode == HOLD:
        for x in range(level.size):
            busy[x] |= dead[x] > 0
    eights, count = busy.view(np.uint64), 0
    for i in range(eights.size):
        if eights[i]:
            for x in range(8 * i, 8 * i + 8):
                active[count] = x
                count += busy[x]
    return count


@kernel
def find_events(chip, wait, memory, scratch, steps, done, last):
    """Take the active pixels `done` .. `last` - 1 through an interval, until the batch is full.

    Returns the number of events in the batch and of the pixels that are done.
    """
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift, on_, off_ = scratch.level, scratch.drift, scratch.on, scratch.off
    active, noise_u, noise_sign = scratch.active, scratch.noise_u, scratch.noise_sign
    batch = scratch.who, scratch.when, scratch.sign
    mode, v2e, count = chip.mode, chip.v2e, 0
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
    unit, c, v, first, _, width = place
    who, when, sign = scratch.who, scratch.when, scratch.sign
    counts, offsets, events = sink.counts, sink.offsets, sink.events
    if sink.output == VOXELS:
        add_to_grid(sink.voxels[c, clock[0], v, :, first:], who, when, sign, number, clock)
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
def start(clip, key, memory, scratch):
    """Let the memory begin with its levels, the references off from them by the residual."""
    level, reference, drawn = memory.level, memory.reference, scratch.drawn
    memory.source[:], reference[:], memory.dead[:] = level, level, f32(0)
    if clip.residual > 0:
        draw_bits(key, 1, 0, scratch.pixel, drawn)
        for x in range(level.size):
            uniform = (f32(drawn[x] >> uint32(9)) + f32(0.5)) * f32(2.0**-23)
            away = np.float64(f32(2) * uniform - f32(1)) * clip.residual
            threshold = scratch.on[x] if away > 0 else scratch.off[x]
            reference[x] = level[x] - i32(away * threshold)


@kernel
def advance(chip, clip, memory, scratch, sink, place, key, frame, clock):
    """Take one unit through interval `frame`, at whose end the levels are those of the scratch."""
    level, reference, dead = memory.level, memory.reference, memory.dead
    new, drift = scratch.level, scratch.drift
    steps = busiest(chip.mode, memory, scratch) if chip.v2e else np.int64(1)
    done, last = 0, find_active(chip.mode, memory, scratch)
    if clip.shot or clip.hot:
        draw_noise(scratch, key, frame, last)
    while done < last:
        number, done = find_events(chip, f32(clip.wait), memory, scratch, steps, done, last)
        deliver(sink, place, scratch, number, clock)
    if clip.leak:
        for x in range(level.size):
            reference[x] -= drift[x]
    level[:] = new
    for x in range(level.size):
        dead[x] = max(dead[x] - f32(1), f32(0))


@kernel
def see(chip, frames, place, frame, scratch, levels):
    """Fill levels before the low-pass and return (light, whether any of it may be wrong).

    `frames` are two arrays: float32, and the bits of float16, one of them empty.
    """
    _, c, v, first, last, _ = place
    wide, halves = frames
    if halves.size:
        seen = scratch.intensity
        return seen, read_halves(chip.level, halves[c, v, frame, first:last], seen, levels)
    seen = wide[c, v, frame, first:last]
    return seen, read_levels(chip.level, seen, levels)


@kernel
def disturb(chip, clip, hots, memory, scratch, intensity, key, frame):
    """Let the low-pass, noise and leak have their part in interval `frame`."""
    if len(chip.low_pass):
        tables = chip.low_pass[clip.low_pass]
        low_pass(tables[0], tables[1], intensity, memory, scratch.level)
    if clip.shot or hots:
        mark_noise(clip, hots, scratch, key, frame, intensity)
    if clip.leak:
        draw_leak(clip.leak, scratch, frame)


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
        np.empty(size, np.int32), np.empty(size, np.uint32), np.empty(size, np.uint32),
        np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.uint32),
        np.zeros(size, np.int32),
        np.empty(size, np.float32), np.empty(size, np.int32), np.zeros(size, np.uint8),
        np.empty(whole + 1, np.uint32), np.zeros(whole, np.uint8),
        np.full(size, f32(2)), np.ones(size, np.int8),
        np.empty(room, np.uint32), np.empty(room, np.float32), np.empty(room, np.int8),
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def simulate(
    first_unit, last_unit, size, frames, fresh, chip, memory, edges, first, substeps, sink
):
    """Simulate units first_unit .. last_unit - 1: `size` consecutive pixels of a view each.

    Returns whether any light is negative or above 1.
    """
    views, pixels = memory.level.shape[1:]
    units, doubtful = (pixels + size - 1) // size, False
    for unit in range(first_unit, last_unit):
        c, v, a = unit // (views * units), unit // units % views, unit % units * size
        b = min(a + size, pixels)
        own = Memory(
            memory.level[c, v, a:b], memory.source[c, v, a:b],
            memory.reference[c, v, a:b], memory.dead[c, v, a:b],
        )  # fmt: skip
        clip, keys, place = chip.clips[c], chip.keys[c, v], (unit, c, v, a, b, chip.width)
        scratch = make_scratch(b - a, min(clip.on, clip.off))
        number_pixels(clip, chip.width, a, scratch.pixel)
        hots = make_chip(clip, keys, chip.normals, scratch)
        mix_pixels(keys[SHOT], scratch.pixel, scratch.mixed)
        if fresh:
            doubtful |= see(chip, frames, place, 0, scratch, own.level)[1]
            start(clip, keys[RESIDUAL], own, scratch)
        for i in range(edges.shape[1] - 1):
            clock = clock_at(edges[c], i, substeps, sink.voxels.shape[3])
            light, beyond = see(chip, frames, place, i + fresh, scratch, scratch.level)
            disturb(chip, clip, hots, own, scratch, light, keys[SHOT], first + i)
            advance(chip, clip, own, scratch, sink, place, keys[SHOT], first + i, clock)
            doubtful |= beyond
        if not len(chip.low_pass):
            own.source[:] = own.level
    return doubtful
