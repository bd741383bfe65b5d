"""Pieces of events: clocks of 32 bits that begin anew, and small pieces joined to larger ones."""

from collections.abc import Iterator

import numpy as np

from src.recordings.files.event_file import PIECE_EVENTS, RawEvents

CLOCK = 2**32  # microseconds, after which a clock of 32 bits begins anew


class Clock:
    """A clock of 32 bits that is read in pieces: it went round where it falls by more than half."""

    def __init__(self):
        self._last, self._rounds = 0, 0

    def go_on(self, t: np.ndarray) -> np.ndarray:
        """Return the times (n,) uint32 as int64 with the rounds since the first piece."""
        times = t.astype(np.int64)
        if len(times):
            rounds = np.cumsum(np.diff(times, prepend=self._last) < -CLOCK // 2) + self._rounds
            self._last, self._rounds = int(times[-1]), int(rounds[-1])
            times += rounds * CLOCK
        return times


def merge_small_pieces(pieces: Iterator[RawEvents]) -> Iterator[RawEvents]:
    """Yield the events in pieces of PIECE_EVENTS or more, the last one apart; none is empty."""
    held: list[RawEvents] = []
    for piece in pieces:
        held.append(piece)
        if sum(len(part.t) for part in held) >= PIECE_EVENTS:
            yield RawEvents(*map(np.concatenate, zip(*held, strict=True)))
            held = []
    if any(len(part.t) for part in held):
        yield RawEvents(*map(np.concatenate, zip(*held, strict=True)))
