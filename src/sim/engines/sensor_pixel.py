"""One pixel over one frame interval: when its events come, and what it remembers (numba).

Levels are integers (2**-20 nat), times are float32 fractions of the interval.  An event comes at
the first moment at which the pixel is not dead and the level is a threshold or more from the
reference; between frames the level moves linearly, so crossings form an arithmetic progression
and each costs one division.  Events are written to `when` and `sign`; their number, the reference
and the end of the dead time are returned.
"""

import numpy as np
from numba import njit, uint32, uint64

DEFER, DELETE, HOLD = 0, 1, 2

f32 = np.float32


@njit(nogil=True, inline="always")
def mix(x):
    """The 32-bit finaliser of src.sim.noise."""
    x = uint32(x)
    x ^= x >> uint32(16)
    x = uint32(x * uint32(0x7FEB352D))
    x ^= x >> uint32(15)
    x = uint32(x * uint32(0x846CA68B))
    return uint32(x ^ (x >> uint32(16)))


@njit(nogil=True, inline="always")
def bits(key, high, low):
    """src.sim.noise.bits(key, high * 2**32 + low), the same 32 bits."""
    mixed = mix(uint32(low) ^ uint32(uint64(key) & uint64(0xFFFFFFFF)))
    upper = uint32(uint64(key) >> uint64(32))
    return mix(uint32(mixed + uint32(uint32(high) * uint32(0x9E3779B9)) + upper))


@njit(nogil=True, inline="always")
def level_at(start, delta, u):
    """Return the level at fraction `u` of an interval that begins at `start`."""
    return start + np.int64(np.rint(f32(u) * f32(delta)))


@njit(nogil=True)
def linear_events(l0, l1, ref, dead, on, off, wait, mode, noise_u, noise_sign, when, sign):
    """Return (events, ref, dead); `noise_u` is the time of a noise event, above 1 for none."""
    delta = l1 - l0
    count = 0
    start = f32(0)
    stop = min(noise_u, f32(1))
    holding = mode == HOLD and dead > start
    while True:
        if holding:  # the reference is held in reset until the dead time ends
            if dead <= stop:
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


@njit(nogil=True, inline="always")
def next_crossing(l0, delta, ref, on, off, now):
    """Return (time, polarity) of the first threshold exceeded at or after `now`; time 2 if none."""
    if delta >= 0:
        ahead, behind, speed, s = ref + on - l0, ref - off - l0, f32(delta), 1
    else:
        ahead, behind, speed, s = l0 - ref + off, l0 - ref - on, f32(-delta), -1
    if behind >= 0 and f32(behind) >= now * speed:  # exceeded before, and still so
        return now, -s
    if f32(ahead) > speed:
        return f32(2), s
    if ahead <= 0:
        return now, s
    return max(now, f32(ahead) / speed), s


@njit(nogil=True)
def v2e_crossings(l0, l1, ref, dead, on, off, mode):
    """Return (thresholds between the reference and the frame's level, reference)."""
    if mode == HOLD and dead > 1:
        return 0, ref
    if mode == HOLD and dead > 0:
        ref = level_at(l0, l1 - l0, dead)
    return (l1 - ref) // on if l1 >= ref else (ref - l1) // off, ref


@njit(nogil=True)
def v2e_events(l0, l1, ref, dead, on, off, wait, mode, steps, noise_u, noise_sign, when, sign):
    """The same with v2e's time stamps: `steps` stamps for the whole frame, set by its busiest pixel.

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
