"""The sensor's definition, one pixel and one event at a time, in exact fractions: slow, and plain.

Levels and thresholds are integers.  `linear` asks for the earliest moment at which the pixel may
fire; `v2e` follows the steps of v2e's emulator (Hu et al. 2021) frame by frame.
"""

from fractions import Fraction
from itertools import pairwise
from math import ceil

import numpy as np


def linear(levels, on, off, wait, mode):
    """Return [(interval, fraction, polarity)] and the reference of one pixel's level sequence."""
    wait, ref, dead, resets, out = Fraction(wait), levels[0], Fraction(0), False, []
    for k, (l0, l1) in enumerate(pairwise(levels)):
        now = Fraction(0)
        while True:
            if resets:
                if dead > 1:
                    break
                ref, resets = _reset_level(l0, l1, dead), False
            if mode != "delete":
                now = max(now, dead)
            reached = [
                (_first(l0, l1, ref + on, now, 1), 1),
                (_first(l0, l1, ref - off, now, -1), -1),
            ]
            u, p = min(reached, key=lambda event: event[0])
            if u > 1:
                break
            ref, now = ref + (on if p > 0 else -off), u
            if u >= dead:
                out.append((k, u, p))
                dead = u + wait
                resets = mode == "hold" and wait > 0
        dead = max(dead - 1, Fraction(0))
    return out, ref


def _first(l0, l1, target, now, side):
    """Return the first moment from `now` on with the level at or beyond `target`; 2 for never."""
    if side * (l0 + now * (l1 - l0) - target) >= 0:
        return now
    if side * (l1 - l0) <= 0 or side * (l1 - target) < 0:
        return Fraction(2)
    return Fraction(target - l0, l1 - l0)


def _reset_level(l0, l1, u):
    """The level at the end of a reset is rounded as float32 does."""
    return l0 + int(np.rint(np.float32(u) * np.float32(l1 - l0)))


def v2e(pixels, on, off, wait, mode):
    """Return, for a list of level sequences, their [(interval, fraction, polarity)] lists."""
    base = [levels[0] for levels in pixels]
    last = [None] * len(pixels)  # absolute time of the last event recorded
    out = [[] for _ in pixels]
    for k in range(len(pixels[0]) - 1):
        counts = []
        for i, levels in enumerate(pixels):
            if mode == "hold" and last[i] is not None and base[i] is None:
                end = last[i] + wait
                if end > k + 1:
                    counts.append(0)
                    continue
                base[i] = _reset_level(levels[k], levels[k + 1], end - k)
            change = levels[k + 1] - base[i]
            counts.append(change // on if change >= 0 else -change // off)
        steps = max(1, *counts)
        tested = wait * steps > 1
        for i, levels in enumerate(pixels):
            for j in range(1, counts[i] + 1):
                change, stamp = levels[k + 1] - base[i], Fraction(j, steps)
                p = 1 if change >= on else -1 if -change >= off else 0
                if p == 0:
                    break
                kept = not tested or last[i] is None or k + stamp - last[i] > wait
                if kept:
                    out[i].append((k, stamp, p))
                if kept or mode == "delete":
                    base[i] += on if p > 0 else -off
                if kept and tested:
                    last[i] = k + stamp
                    if mode == "hold":
                        end = last[i] + wait
                        if end > k + 1:
                            base[i] = None
                            break
                        base[i] = _reset_level(levels[k], levels[k + 1], end - k)
    return out


def ticks(events, edges):
    """Return [(microsecond, polarity)] of the events on the sensor's clock."""
    return [(edges[k] + max(ceil(u * (edges[k + 1] - edges[k])) - 1, 0), p) for k, u, p in events]
