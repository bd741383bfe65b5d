"""Words of Prophesee's EVT formats to events (Metavision's pages "EVT 2.0", "EVT 2.1", "EVT 3.0").

Time comes in two words: its high bits alone, which count on from 0 when they are full, and its low
bits.  Before the first high bits the time of an event is not known: it is counted, not given out.
`state` is carried from block to block, (8,) int64 from `new_decoder_state`.
"""

import numpy as np
from numba import njit

BASE, HIGH, LOW, ROW, COLUMN, ON, TRIGGERS, LOST = range(8)  # places in `state`
TIME, TRIGGER = 8, 10  # kinds of words: high bits of time, an edge on a trigger input


def new_decoder_state() -> np.ndarray:
    """Return the state before a file's first word."""
    state = np.zeros(8, np.int64)
    state[HIGH] = -1
    return state


@njit(nogil=True, cache=True)
def decode_evt2_and_21(upper_words, masks, state, t, x, y, p):
    """Write the events of EVT2.1's words, their upper and lower 32 bits (n,), to t, x, y, p
    (32 n,); return how many.  A word of EVT2 is an upper half with a mask of 1: one event.
    """
    found, base, high = 0, state[BASE], state[HIGH]
    for i in range(upper_words.size):
        word, mask = upper_words[i], masks[i]
        kind = word >> 28
        if kind < 2:
            now, start = base + (high << 6) + np.int64(word >> 22 & 63), found
            found = _add(mask, word >> 11 & 2047, word & 2047, kind, now, t, x, y, p, found)
            if high < 0:
                state[LOST] += found - start
                found = start
        elif kind == TIME:
            base, high = _set_high(base, high, np.int64(word & 0xFFFFFFF), 28, 6)
        elif kind == TRIGGER:
            state[TRIGGERS] += 1
    state[BASE], state[HIGH] = base, high
    return found


@njit(nogil=True, cache=True)
def decode_evt3(words, state, t, x, y, p):
    """Write the events of `words` (n,) uint16 to t, x, y, p (12 n,); return how many."""
    found, now = 0, state[BASE] + (state[HIGH] << 12) + state[LOW]
    base, high, row, column, on = state[BASE], state[HIGH], state[ROW], state[COLUMN], state[ON]
    for value in words:
        word = np.int64(value)
        kind = word >> 12
        if kind == 2:
            t[found], x[found], y[found], p[found] = now, word & 2047, row, word >> 11 & 1
            found += 1
        elif kind == 0:
            row = word & 2047
        elif kind == 3:
            column, on = word & 2047, word >> 11 & 1
        elif kind == 4:
            found = _add(word & 4095, column, row, on, now, t, x, y, p, found)
            column += 12
        elif kind == 5:
            found = _add(word & 255, column, row, on, now, t, x, y, p, found)
            column += 8
        elif kind == 6:
            now = base + (high << 12) + (word & 4095)
        elif kind == TIME and word & 4095 != high:
            if high < 0:
                state[LOST], found = state[LOST] + found, 0
            base, high = _set_high(base, high, word & 4095, 12, 12)
            now = base + (high << 12)  # its low bits follow
        elif kind == TRIGGER:
            state[TRIGGERS] += 1
    if high < 0:
        state[LOST], found = state[LOST] + found, 0
    state[BASE], state[HIGH], state[ROW], state[COLUMN], state[ON] = base, high, row, column, on
    state[LOW] = now - base - (high << 12)
    return found


@njit(nogil=True, cache=True, inline="always")
def _add(mask, column, row, on, now, t, x, y, p, found):
    """Add the events of a row whose bits are set in `mask`, the first at `column`."""
    while mask:
        if mask & 1:
            t[found], x[found], y[found], p[found] = now, column, row, on
            found += 1
        mask >>= 1
        column += 1
    return found


@njit(nogil=True, cache=True, inline="always")
def _set_high(base, high, new, bits, shift):
    """Return the times after new high bits; where they fall by more than half, they began anew."""
    return base + (np.int64(new < high - (1 << (bits - 1))) << (bits + shift)), new
