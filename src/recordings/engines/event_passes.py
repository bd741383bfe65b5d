"""Passes over a list of events that look at each of them: its decoder's faults, its neighbours."""

import numpy as np
from numba import njit

MAX_TIME_US = 2**62
LONG_AGO_US = -MAX_TIME_US
MAX_COORDINATE = 65535  # x and y have 16 bits
KEPT, DROPPED, RIVAL, RETURNED, NEITHER = range(5)  # labels; the last three are not final
LONGEST_SILENCE_US = 3_600_000_000  # events later by more are of another clock
LAST_GAP_US = 1_000_000  # a few last events later by more, and by LAST_GAP times the file, too
LAST_GAP = 10


@njit(nogil=True, cache=True)
def copy_events_on_sensor(t, x, y, p, width, height, largest_xy, out):
    """Fill `out` with the events on the sensor; return (kept, outside, wrong).

    `t` int64 us; `p` is ON where positive, else OFF.  One outside `width` x `height` (0: not known)
    is left out and counted.  `wrong`: the place of the first event whose time is beyond 2^62 us,
    whose polarity is none of -1, 0, 1 or, where the size is not known, whose x or y is not in
    0..65535; -1 for none.  `largest_xy`: so far, (2,) int64.
    """
    kept = outside = 0
    most_x, most_y = largest_xy[0], largest_xy[1]
    for i in range(t.size):
        now, column, row, sign = t[i], np.int64(x[i]), np.int64(y[i]), p[i]
        if sign < -1 or sign > 1 or now <= LONG_AGO_US or now >= MAX_TIME_US:
            return kept, outside, i
        most_x, most_y = max(most_x, column), max(most_y, row)
        if width > 0:
            if not (0 <= column < width and 0 <= row < height):
                outside += 1
                continue
        elif not (0 <= column <= MAX_COORDINATE and 0 <= row <= MAX_COORDINATE):
            return kept, outside, i
        out[kept].t, out[kept].x, out[kept].y = now, column, row
        out[kept].p = 1 if sign > 0 else -1
        kept += 1
    largest_xy[0], largest_xy[1] = most_x, most_y
    return kept, outside, -1


@njit(nogil=True, cache=True)
def label_kept_or_dropped(t, first, latest, count, buffer_us, min_part_events, at_end, labels):
    """Write KEPT or DROPPED to `labels` of events in their order; return (decided, latest, count,
    restarted): those from `decided` on wait for what follows or, `restarted`, for another clock.

    `first`, `latest`, `count` are of the events kept so far.  An event within `buffer_us` of the
    latest is kept.  One further away opens a challenge: it and those that go on from it are rivals,
    those that go on from the latest return.  `min_part_events` rivals win: later ones are kept as
    after a silence, earlier ones are a clock that restarts.  Returned events win when they are as
    many.  The others are outliers.  `at_end` nothing follows: later rivals win, unless they are few
    and far (LAST_GAP), earlier ones are outliers.
    """
    i, begin, aside = 0, -1, -1  # the challenge, and the first event in it that is neither
    later, rival, ours, rivals, returned = False, latest, latest, 0, 0
    while True:
        while i < t.size:
            now = t[i]
            if begin < 0:
                if count == 0 or -buffer_us <= now - latest <= buffer_us:
                    latest, first = (now, now) if count == 0 else (max(latest, now), first)
                    labels[i], count = KEPT, count + 1
                else:
                    begin, aside, later, rival, ours = i, -1, now > latest, now, latest
                    labels[i], rivals, returned = RIVAL, 1, 0
            elif now >= rival - buffer_us if later else now < ours - buffer_us:
                labels[i], rivals, rival = RIVAL, rivals + 1, max(rival, now)
            else:
                returned += 1
                if ours - buffer_us <= now <= ours + buffer_us:
                    labels[i], ours = RETURNED, max(ours, now)
                else:
                    labels[i], aside = NEITHER, i if aside < 0 else aside
            i += 1
            if begin >= 0 and (rivals >= min_part_events or returned >= rivals):
                break
        if begin < 0:
            return t.size, latest, count, False
        if i == t.size and rivals < min_part_events and returned < rivals and not at_end:
            return begin, latest, count, False
        gap = t[begin] - latest
        wins = rivals >= min_part_events or (at_end and returned < rivals and later)
        if rivals >= min_part_events and (not later or gap > LONGEST_SILENCE_US):
            return begin, latest, count, True
        if rivals < min_part_events and gap > max(LAST_GAP_US, LAST_GAP * (latest - first)):
            wins = wins and rivals * 100 > count
        winner, end = (RIVAL, i) if wins else (RETURNED, i if aside < 0 else aside)
        for k in range(begin, end):
            near = later and not wins and labels[k] == RIVAL and t[k] <= ours + buffer_us
            labels[k] = KEPT if labels[k] == winner or near else DROPPED
            if labels[k] == KEPT:
                latest, count = max(latest, t[k]), count + 1
        i, begin = end, -1


@njit(nogil=True, cache=True)
def mark_supported_events(t, x, y, latest_us, support_us, kept):
    """Write to `kept` which events are supported, and their times to `latest_us` (h + 2, w + 2).

    Return the place of the first event off the sensor, from which on nothing is done; -1 for none.
    """
    height, width = latest_us.shape[0] - 2, latest_us.shape[1] - 2
    for i in range(t.size):
        row, column = np.int64(y[i]) + 1, np.int64(x[i]) + 1
        if not (0 < row <= height and 0 < column <= width):
            return i
        latest_us[row, column] = LONG_AGO_US
        kept[i] = False
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                kept[i] |= 0 <= t[i] - latest_us[r, c] <= support_us
        latest_us[row, column] = t[i]
    return -1
