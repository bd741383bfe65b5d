"""Packets of iniVation's cameras as their ROS driver sends them in EventPacket messages.

`libcaer` (libcaer's polarity.h): two words of 32 bits an event.  The first has, from the lowest
bit, 1 of validity, 1 ON, 15 of y and 15 of x; the second is the time in microseconds after the
packet's time_base, of 31 bits.  `libcaer_cmp` (event_camera_codecs): words of 16 bits, the upper
four say which: the high and the low 12 bits of the time after time_base, 11 of x, 11 of y and ON,
the first y and ON of a column's rows, and which of its next eight rows have an event.
"""

import numpy as np

from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.event_file import RawEvents

TIME_HIGH, TIME_LOW, COLUMN, ROW, FIRST_ROW, ROWS = range(6)  # kinds of words of libcaer_cmp
CLOCK_BITS = 31  # of libcaer's microseconds


def decode_libcaer(words: np.ndarray, start_ns: int) -> RawEvents:
    """Return the events of a packet (2 n,) uint32, times in nanoseconds; raises ValueError for a
    packet that ends within an event."""
    pixel, t = words.reshape(-1, 2).T
    times = TimestampUnwrapper(CLOCK_BITS).unwrap(t)
    x, y = (pixel >> 17).astype(np.uint16), (pixel >> 2 & 0x7FFF).astype(np.uint16)
    return RawEvents(times * 1000 + start_ns, x, y, pixel >> 1 & 1)


def decode_compressed_libcaer(words: np.ndarray, start_ns: int) -> RawEvents:
    """Return the events of a packet (n,) uint16, times in nanoseconds; raises ValueError for words
    of another kind and events without a place."""
    kinds, values = words >> 12, (words & 0xFFF).astype(np.int64)
    if (kinds > ROWS).any():
        raise ValueError(f"a word of kind {kinds.max()} in libcaer_cmp, known are 0 to {ROWS}")
    is_rows = kinds == ROWS
    rows_before = np.cumsum(is_rows) - is_rows
    which = np.where(is_rows, values & 0xFF, kinds == ROW).astype(np.uint8)
    found = np.flatnonzero(np.unpackbits(which, bitorder="little").view(bool))
    word, bit = found >> 3, found & 7
    high, low, column, first = (
        _latest(kinds, kind)[word] for kind in (TIME_HIGH, TIME_LOW, COLUMN, FIRST_ROW)
    )
    start = np.where(is_rows[word], first, word)
    if (column < 0).any() or (start < 0).any():
        raise ValueError("an event before the word of its column or first row in libcaer_cmp")
    y = (values[start] & 0x7FF) + 8 * (rows_before[word] - rows_before[start]) + bit
    t = _value(values, high) << 12 | _value(values, low)
    return RawEvents(t * 1000 + start_ns, values[column] & 0x7FF, y, values[start] >> 11)


def _latest(kinds: np.ndarray, kind: int) -> np.ndarray:
    """Return for each word the place of the last one of `kind` so far, -1 where there is none."""
    return np.maximum.accumulate(np.where(kinds == kind, np.arange(len(kinds)), -1))


def _value(values: np.ndarray, places: np.ndarray) -> np.ndarray:
    return np.where(places < 0, 0, values[places])
