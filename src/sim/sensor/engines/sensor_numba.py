"""The sensor's kernels for the CPU (numba), all in one file: its cache does not see other files.

Levels are integers (2**-20 nat), times are float32 fractions of the frame interval.  An event comes
at the first moment at which the pixel is not dead and the level is a threshold or more from the
reference; between frames the level moves linearly, so that each crossing costs one division.
"""

from collections import namedtuple

import numpy as np
from numba import njit, uint32, uint64

from src.sim.sensor.engines import records
from src.sim.sensor.engines.records import DELETE, HOLD

f32, i32 = np.float32, np.int32
DARKEST, BRIGHTEST, WHITE = 0x38800000, 0x3FFFFFFF, 0x3F800000  # bits of 2**-14, of below 2, of 1
DARKEST_HALF, BRIGHTEST_HALF, WHITE_HALF = 0x0400, 0x4000, 0x3C00  # of float16
MISMATCH_KEY, HOT_PIXEL_KEY, NOISE_KEY, REFERENCE_KEY = range(records.KEYS)
kernel = njit(nogil=True, error_model="numpy")  # no test for a zero divisor
inline_kernel = njit(nogil=True, error_model="numpy", inline="always")

# Arrays over the pixels of a unit, and a batch of events (the last three).  Pixels remember between
# frames: `level` and `source`, the last frame's level after and before the low-pass, 2**-20 nat;
# `reference`, the memorised level; `dead`, the end of the dead time, in frame intervals after the
# last frame.  `pixel`: the number in the whole frame; `drawn`: random bits; `mixed`: the part of a
# pixel's noise that is the same in all frames; `hot`: the hot pixels, which come first; `drift`:
# what the reference leaks; `intensity`, of float16 frames, and `new_level`: the new frame's;
# `noisy`: whether there is a noise event; `active`: those pixels that are `busy`; `noise_u`,
# `noise_sign`: time and polarity of their noise events; `event_pixel`, `event_u`, `event_sign`: an
# event's pixel of the unit, fraction of the interval and polarity.
Workspace = namedtuple(
    "Workspace",
    "level source reference dead pixel drawn mixed on off hot drift intensity new_level noisy "
    "active busy noise_u noise_sign event_pixel event_u event_sign",
)


@inline_kernel
def mix_bits(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = uint32(x)
    x ^= x >> uint32(16)
    x = uint32(x * uint32(0x7FEB352D))
    x ^= x >> uint32(15)
    x = uint32(x * uint32(0x846CA68B))
    return uint32(x ^ (x >> uint32(16)))


@inline_kernel
def random_uint32(key, high, low):
    """The 32 bits of src.sim.noise.bits(key, high * 2**32 + low)."""
    mixed = mix_bits(uint32(low) ^ uint32(uint64(key) & uint64(0xFFFFFFFF)))
    upper = uint32(uint64(key) >> uint64(32))
    return mix_bits(uint32(mixed + uint32(uint32(high) * uint32(0x9E3779B9)) + upper))


@inline_kernel
def level_change_at(change, fraction):
    """Return how far a level that moves by `change` in an interval has come at `fraction`."""
    return np.int64(np.rint(f32(fraction) * f32(change)))


@inline_kernel
def append_linear_events(
    x, l0, l1, ref, dead, on, off, wait, mode, noise_u, noise_sign, batch, count
):
    """Append the events of pixel `x` to `batch`, which holds `count`; return (count, ref, dead).

    `noise_u` is the time of a noise event, above 1 for none.  All is seen along the level's way:
    `span` is its length, `at` the reference's place on it.
    """
    pixels, times, signs = batch
    along = 1 if l1 >= l0 else -1
    ahead, behind = (on, off) if l1 >= l0 else (off, on)
    span, at = abs(l1 - l0), (ref - l0) * along
    start = f32(0)
    stop = min(noise_u, f32(1))
    holding = mode == HOLD and dead > start
    while True:
        if holding and dead <= stop:  # the reset ends
            at = level_change_at(span, dead)
            holding = False
        moved = False
        if not holding:
            now = start if mode == DELETE else max(start, dead)
            u, step = find_next_crossing(span, at, ahead, behind, now)
            if u <= stop:
                moved = True
                at += step
                start = u
                if u >= dead:
                    pixels[count], times[count], signs[count] = x, u, along if step > 0 else -along
                    count += 1
                    dead = u + wait
                    holding = mode == HOLD and wait > 0
        if moved:
            continue
        if stop != noise_u:
            return count, l0 + at * along, dead
        if noise_u >= dead:
            pixels[count], times[count], signs[count] = x, noise_u, noise_sign
            count += 1
            at = level_change_at(span, noise_u)
            dead = noise_u + wait
            holding = mode == HOLD and wait > 0
        start, stop, noise_u = noise_u, f32(1), f32(2)


@inline_kernel
def find_next_crossing(span, at, ahead, behind, now):
    """Return time and step of the first threshold exceeded at or after `now`; time 2 if none."""
    if at >= behind and f32(at - behind) >= now * f32(span):  # exceeded before, and still so
        return now, -behind
    if at + ahead > span:
        return f32(2), ahead
    u = f32(at + ahead) / f32(span)
    return (u if u > now else now), ahead  # now, if it was exceeded before: also at 0 / 0


@inline_kernel
def count_v2e_crossings(l0, l1, ref, dead, on, off, mode):
    """Return (thresholds between the reference and the frame's level, reference)."""
    if mode == HOLD and dead > 1:
        return 0, ref
    if mode == HOLD and dead > 0:
        ref = l0 + level_change_at(l1 - l0, dead)
    return (l1 - ref) // on if l1 >= ref else (ref - l1) // off, ref


@inline_kernel
def append_v2e_events(
    x, l0, l1, ref, dead, on, off, wait, mode, steps, noise_u, noise_sign, batch, count
):
    """The same with v2e's time stamps, `steps` in the whole view: the most crossings of a pixel.

    The pixel's first crossings take the first stamps; a stamp within the dead time is refused
    (compute_events of v2e's emulator).  Where a stamp interval is longer than the refractory
    period, v2e neither tests nor records it.  Noise is stamped at the interval's end.
    """
    pixels, times, signs = batch
    tested = wait * f32(steps) > 1
    crossings, ref = count_v2e_crossings(l0, l1, ref, dead, on, off, mode)
    for i in range(1, crossings + 1):
        stamp = f32(i) / f32(steps)
        s = 1 if l1 - ref >= on else (-1 if ref - l1 >= off else 0)
        if s == 0:
            break
        kept = not tested or stamp > dead
        if kept:
            pixels[count], times[count], signs[count] = x, stamp, s
            count += 1
            if tested:
                dead = stamp + wait
        if kept or mode == DELETE:
            ref += on if s > 0 else -off
        if kept and tested and mode == HOLD:
            if dead > 1:
                break
            ref = l0 + level_change_at(l1 - l0, dead)
    if noise_u <= 1:
        pixels[count], times[count], signs[count] = x, f32(1), noise_sign
        count += 1
        ref = l1
    return count, ref, dead


@inline_kernel
def fixed_point_table_position(intensity_bits):
    """Return the place in the tables of an intensity, given by the bits of its float."""
    return i32(min(max(i32(intensity_bits), i32(DARKEST)), i32(BRIGHTEST)) - i32(DARKEST))


@inline_kernel
def read_table(table, position):
    cell, inside = uint32(position) >> uint32(13), i32(position & i32(8191))
    left = table[cell]
    part = i32(i32(table[cell + uint32(1)] - left) * inside) >> i32(13)
    return i32(i32(left + i32(part) + i32(8)) >> i32(4))


@kernel
def read_levels(table, intensity, levels):
    """Fill `levels` with a frame's levels before the low-pass; return whether any intensity is
    negative or above 1: the bits of such floats are the larger numbers.
    """
    places, most = intensity.view(np.uint32), uint32(0)
    for x in range(places.size):
        most = max(most, places[x])
        levels[x] = read_table(table, fixed_point_table_position(places[x]))
    return most > WHITE


@kernel
def read_float16_levels(table, halves, intensity, levels):
    """The same of the bits of float16, whose lights are the table's nodes; widened in `intensity`.

    In a float32's place the exponent is too small by 127 - 15: exact also below 2**-14.
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
def apply_low_pass(decay, lag, intensity, old_level, old_source, level):
    """Filter the new frame's levels in place; the old ones are those of the frame before."""
    places = intensity.view(np.int32)
    for x in range(places.size):
        place, source = fixed_point_table_position(places[x]), level[x]
        old = np.int64(old_level[x] - old_source[x]) * read_table(decay, place)
        old -= np.int64(source - old_source[x]) * read_table(lag, place)
        level[x], old_source[x] = source + ((old + 524288) >> 20), source


@kernel
def fill_pixel_numbers(clip, width, first, pixel):
    for x in range(pixel.size):
        row, column = (first + x) // width, (first + x) % width
        pixel[x] = (clip.top + row) * clip.full_width + clip.left + column


@kernel
def draw_thresholds_and_hot_pixels(clip, keys, normals, work):
    """Fill thresholds and hot pixels of a unit, the same in all clips; return how many are hot."""
    on, off, hot, pixel, drawn = work.on, work.off, work.hot, work.pixel, work.drawn
    on[:], off[:], hot_count = clip.on, clip.off, 0
    if clip.mismatch > 0:
        draw_uint32_per_pixel(keys[MISMATCH_KEY], 2, 0, pixel, drawn)
        spread_thresholds(clip.on, clip.mismatch, normals, drawn, on)
        draw_uint32_per_pixel(keys[MISMATCH_KEY], 2, 1, pixel, drawn)
        spread_thresholds(clip.off, clip.mismatch, normals, drawn, off)
    if clip.hot_fraction > 0:
        draw_uint32_per_pixel(keys[HOT_PIXEL_KEY], 1, 0, pixel, drawn)
        for x in range(pixel.size):
            if drawn[x] < clip.hot_fraction:
                hot[hot_count] = x
                hot_count += 1
    return hot_count


@kernel
def draw_uint32_per_pixel(key, words, word, pixel, drawn):
    """Fill random_uint32(key, 0, words * pixel + word); a pixel has so many words."""
    for x in range(pixel.size):
        drawn[x] = random_uint32(key, 0, uint32(words) * uint32(pixel[x]) + uint32(word))


@kernel
def spread_thresholds(threshold, mismatch, normals, drawn, out):
    """Fill threshold * (1 + mismatch * normal), at least a quarter of the threshold."""
    deviation, least = (threshold * mismatch) >> 20, threshold >> 2
    for x in range(drawn.size):
        cell, inside = drawn[x] >> uint32(20), np.int64(drawn[x] & uint32(0xFFFFF))
        left = normals[cell]
        normal = left + (((normals[cell + uint32(1)] - left) * inside) >> 20)
        out[x] = max(threshold + ((deviation * normal) >> 20), least)


@kernel
def prehash_pixels(key, pixel, mixed):
    """Fill the part of random_uint32(key, frame, 2 * pixel) that is the same in all frames."""
    low = uint32(uint64(key) & uint64(0xFFFFFFFF))
    for x in range(pixel.size):
        mixed[x] = mix_bits(uint32(2) * uint32(pixel[x]) ^ low)


@kernel
def mark_noisy_pixels(clip, hot_count, work, key, frame, intensity):
    """Mark the pixels with a noise event in interval `frame`; white has a quarter (v2e)."""
    mixed, noisy = work.mixed, work.noisy
    upper = uint32(uint64(key) >> uint64(32)) + uint32(uint32(frame) * uint32(0x9E3779B9))
    most, slope = uint32(clip.dark_noise - 1), uint32(clip.dark_noise >> 8)
    if clip.dark_noise > 0:  # then the probability is nowhere 0, and `most` one below it
        for x in range(intensity.size):
            seen = uint32(i32(min(max(intensity[x], f32(0)), f32(1)) * f32(256)))
            rate = uint32(most - uint32(slope * uint32(uint32(uint32(3) * seen) >> uint32(2))))
            noisy[x] = mix_bits(uint32(mixed[x] + upper)) <= rate
    for x in work.hot[:hot_count]:
        noisy[x] = mix_bits(uint32(mixed[x] + upper)) < clip.hot_noise


@kernel
def draw_noise_events(work, key, frame, active_count):
    """Fill times and polarities of the noise events of the active pixels; time 2 for none."""
    pixel, noisy, active = work.pixel, work.noisy, work.active
    noise_u, noise_sign = work.noise_u, work.noise_sign
    for x in active[:active_count]:
        at = random_uint32(key, frame, uint32(2) * uint32(pixel[x]) + uint32(1))
        u = (f32(at >> uint32(9)) + f32(0.5)) * f32(2.0**-23)
        noise_u[x] = u if noisy[x] else f32(2)
        noise_sign[x] = 1 if at & uint32(1) else -1


@kernel
def compute_leak_drift(leak, work, frame):
    """Fill how far the references leak in interval `frame`, by the whole units leaked so far."""
    on, drift = work.on, work.drift
    for x in range(on.size):
        rate = np.int64(on[x]) * leak
        drift[x] = ((rate * (frame + 1)) >> 24) - ((rate * frame) >> 24)


@kernel
def count_v2e_steps(mode, work):
    """Return the largest number of crossings of any pixel of a unit, at least 1."""
    level, reference, dead = work.level, work.reference, work.dead
    new, drift, on, off = work.new_level, work.drift, work.on, work.off
    steps = np.int64(1)
    for x in range(level.size):
        l1, ref, up, down = np.int64(new[x]) + drift[x], np.int64(reference[x]), on[x], off[x]
        more = (l1 - ref >= (steps + 1) * up) | (ref - l1 >= (steps + 1) * down)
        if more | (mode == HOLD and dead[x] > 0):  # else a division for nothing
            crossings, _ = count_v2e_crossings(np.int64(level[x]), l1, ref, dead[x], up, down, mode)
            steps = max(steps, crossings)
    return steps


@kernel
def list_active_pixels(mode, work):
    """List the pixels that have something to do in `work.active`; return how many."""
    # Without a branch per pixel: which are quiet is not predictable.  But eight in a row often are.
    level, reference, dead = work.level, work.reference, work.dead
    new, drift, on, off = work.new_level, work.drift, work.on, work.off
    active, busy, noisy = work.active, work.busy, work.noisy
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
def advance_active_pixels(given, wait, work, v2e_steps, done, last):
    """Take the active pixels `done` .. `last` - 1 through an interval, until the batch is full;
    return the number of events in it and of the pixels that are done.
    """
    level, reference, dead = work.level, work.reference, work.dead
    new, drift, on_, off_ = work.new_level, work.drift, work.on, work.off
    active, noise_u, noise_sign = work.active, work.noise_u, work.noise_sign
    batch = work.event_pixel, work.event_u, work.event_sign
    mode, v2e, count = given.refractory_mode, given.v2e_stamps, 0
    while done < last and count <= level.size:
        x = active[done]
        on, off = np.int64(on_[x]), np.int64(off_[x])
        l0, l1, ref = np.int64(level[x]), np.int64(new[x]) + drift[x], np.int64(reference[x])
        u, s = noise_u[x], np.int64(noise_sign[x])
        if v2e:
            count, ref, dead[x] = append_v2e_events(
                x, l0, l1, ref, dead[x], on, off, wait, mode, v2e_steps, u, s, batch, count
            )
        else:
            count, ref, dead[x] = append_linear_events(
                x, l0, l1, ref, dead[x], on, off, wait, mode, u, s, batch, count
            )
        reference[x] = ref
        done += 1
    return count, done


@kernel
def add_events_to_output(output, place, width, work, count, clock):
    unit, c, v, first, _ = place
    pixels, times, signs = work.event_pixel, work.event_u, work.event_sign
    grids, tally, events = output
    if grids.size:
        add_events_to_grid(grids[c, clock[0], v, :, first:], pixels, times, signs, count, clock)
    elif events.size:
        for i in range(count):
            at, pixel = tally[unit, 0] + i, first + pixels[i]
            events[at].t, events[at].p = timestamp_us(times[i], clock), signs[i]
            events[at].x, events[at].y = pixel % width, pixel // width
        tally[unit, 0] += count
    else:
        for i in range(count):
            tally[unit, 0 if signs[i] > 0 else 1] += 1


@kernel
def add_events_to_grid(grid, pixels, times, signs, count, clock):
    """Add events to a unit's grid (bins, pixels), bilinear in time."""
    origin, scale, bins = clock[1], clock[2], grid.shape[0]
    for i in range(count):
        tau = f32(f32(timestamp_us(times[i], clock) - origin) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        grid[b, pixels[i]] += f32(signs[i]) * (f32(1) - late)
        if late > 0 and b + 1 < bins:
            grid[b + 1, pixels[i]] += f32(signs[i]) * late


@inline_kernel
def timestamp_us(u, clock):
    """Return the tick of the sensor's clock in which fraction `u` of the interval falls."""
    return clock[3] + max(np.int64(np.ceil(u * f32(clock[4] - clock[3]))) - 1, 0)


@kernel
def initialise_pixel_state(clip, key, work):
    """Let the memory begin with its levels, the references off from them by what is drawn."""
    level, reference, drawn = work.level, work.reference, work.drawn
    for x in range(level.size):  # an array assigned to a slice takes numba a second more to compile
        work.source[x], reference[x], work.dead[x] = level[x], level[x], f32(0)
    if clip.reference_span > 0:
        draw_uint32_per_pixel(key, 1, 0, work.pixel, drawn)
        for x in range(level.size):
            uniform = (f32(drawn[x] >> uint32(9)) + f32(0.5)) * f32(2.0**-23)
            away = (np.float64(uniform) - clip.reference_zero) * clip.reference_span
            threshold = work.on[x] if away > 0 else work.off[x]
            reference[x] = level[x] - i32(away * threshold)


@kernel
def read_frame(given, half_frames, place, frame, work, levels):
    """Fill levels before the low-pass; return the intensities and whether any may be wrong."""
    _, c, v, first, last = place
    if half_frames.size:
        seen, halves = work.intensity, half_frames[c, v, frame, first:last]
        return seen, read_float16_levels(given.level_table, halves, seen, levels)
    seen = given.frames[c, v, frame, first:last]
    return seen, read_levels(given.level_table, seen, levels)


@kernel
def advance_interval(given, clip, hot_count, work, output, place, intensity, key, frame, clock):
    """Take one unit through interval `frame`, at whose end the levels are the new ones."""
    level, reference, dead = work.level, work.reference, work.dead
    new, drift, mode = work.new_level, work.drift, given.refractory_mode
    if len(given.low_pass_tables):
        tables = given.low_pass_tables[clip.low_pass_row]
        apply_low_pass(tables[0], tables[1], intensity, level, work.source, new)
    if clip.dark_noise or hot_count:
        mark_noisy_pixels(clip, hot_count, work, key, frame, intensity)
    if clip.leak:
        compute_leak_drift(clip.leak, work, frame)
    steps = count_v2e_steps(mode, work) if given.v2e_stamps else np.int64(1)
    done, last = np.int64(0), list_active_pixels(mode, work)
    if clip.dark_noise or clip.hot_noise:
        draw_noise_events(work, key, frame, last)
    while done < last:
        number, done = advance_active_pixels(given, f32(clip.refractory), work, steps, done, last)
        if frame >= given.first_interval:
            add_events_to_output(output, place, given.width, work, number, clock)
    if clip.leak:
        for x in range(level.size):
            reference[x] -= drift[x]
    for x in range(level.size):
        level[x] = new[x]
    for x in range(level.size):
        dead[x] = max(dead[x] - f32(1), f32(0))


@kernel
def make_workspace(size, smallest):
    """Return the arrays; a pixel has no more events in an interval than thresholds in 32 nat."""
    whole, most = (size + 7) // 8 * 8, size + 32 + (1 << 25) // max(smallest >> 2, 1024)
    return Workspace(
        np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int32),
        np.empty(size, np.float32),
        np.empty(size, np.int32), np.empty(size, np.uint32), np.empty(size, np.uint32),
        np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.uint32),
        np.zeros(size, np.int32),
        np.empty(size, np.float32), np.empty(size, np.int32), np.zeros(size, np.uint8),
        np.empty(whole + 1, np.uint32), np.zeros(whole, np.uint8),
        np.full(size, f32(2)), np.ones(size, np.int8),
        np.empty(most, np.uint32), np.empty(most, np.float32), np.empty(most, np.int8),
    )  # fmt: skip


@njit(nogil=True, cache=True, error_model="numpy")
def simulate_pixel_blocks(
    first_block, stop_block, given, half_frames, normals, pixels, size, grids, tally, events
):
    """Simulate blocks first_block .. stop_block - 1, `size` consecutive pixels of a view each.

    `given.frames` and `half_frames` (the bits of float16) are (n, views, frames, pixels), one of
    them is empty.  Events are added to `grids` (n, windows, views, bins, pixels), if there are any,
    or listed in `events` from `tally[unit, 0]` on, or else counted in `tally` (units, 2), ON and
    OFF.  Returns whether any intensity is negative or above 1.
    """
    views, bins = given.keys.shape[1], grids.shape[3]
    units, doubtful = (pixels + size - 1) // size, False
    for unit in range(first_block, stop_block):
        c, v, a = unit // (views * units), unit // units % views, unit % units * size
        b = min(a + size, pixels)
        clip, keys, place = given.clips[c], given.keys[c, v], (unit, c, v, a, b)
        key, edges_us = keys[NOISE_KEY], given.edges_us[c]
        work = make_workspace(b - a, min(clip.on, clip.off))
        fill_pixel_numbers(clip, given.width, a, work.pixel)
        hot_count = draw_thresholds_and_hot_pixels(clip, keys, normals, work)
        prehash_pixels(key, work.pixel, work.mixed)
        doubtful |= read_frame(given, half_frames, place, np.int64(0), work, work.level)[1]
        initialise_pixel_state(clip, keys[REFERENCE_KEY], work)
        for i in range(edges_us.size - 1):
            # The interval's window, where that begins, bins per microsecond, and both edges.
            window, step = i // given.substeps, given.substeps
            origin, end = edges_us[window * step], edges_us[(window + 1) * step]
            scale = f32(f32(bins - 1) / f32(end - origin))
            clock = window, origin, scale, edges_us[i], edges_us[i + 1]
            seen, beyond = read_frame(given, half_frames, place, i + 1, work, work.new_level)
            output = grids, tally, events
            advance_interval(given, clip, hot_count, work, output, place, seen, key, i, clock)
            doubtful |= beyond
    return doubtful
