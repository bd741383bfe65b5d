"""Pieces of a file: its words, its counter of time, and small pieces joined to larger ones."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import PIECE_EVENTS, RawEvents


def read_whole_words(
    path: Path, start: int, word_bytes: int, block_words: int = PIECE_EVENTS
) -> Iterator[bytes]:
    """Yield the words of a file from byte `start` on, in blocks; warns of a cut last one."""
    with path.open("rb") as file:
        file.seek(start)
        while block := file.read(word_bytes * block_words):
            if cut := len(block) % word_bytes:
                warnings.warn(f"{path}: ends within an event, it is truncated", stacklevel=4)
            yield block[: len(block) - cut]


class TimestampUnwrapper:
    """A counter of `bits`, read in pieces: it went round where it falls by more than half."""

    def __init__(self, bits: int = 32):
        self._bits, self._last, self._rounds = bits, 0, 0

    def unwrap(self, t: np.ndarray) -> np.ndarray:
        """Return the times (n,) as int64 with the rounds since the first piece."""
        times = t.astype(np.int64)
        if len(times):
            has_wrapped = np.diff(times, prepend=self._last) < -(1 << self._bits - 1)
            rounds = np.cumsum(has_wrapped) + self._rounds
            self._last, self._rounds = int(times[-1]), int(rounds[-1])
            times += rounds << self._bits
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
