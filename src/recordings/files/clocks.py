"""Pieces of a file: its words, its counter of time, and small pieces joined to larger ones."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import PIECE_EVENTS, RawEvents

BLOCK_BYTES = 2**20
LEAST_ZEROS = 64  # bytes at the end that are no events, but were never written
NEARLY_A_TURN = 0.98  # of a counter's turn, by which a late event from before its end rises
LATE_EVENTS = 1000  # at most, of which one follows the other before the counter falls again


def read_whole_words(
    path: Path, start: int, word_bytes: int, block_words: int = PIECE_EVENTS
) -> Iterator[bytes]:
    """Yield the whole words of a file from byte `start` on, in blocks, without zeros at its end;
    warns of these (`find_end_before_zeros`) and of a cut last word."""
    left, zeros = find_end_before_zeros(path, start)
    with path.open("rb") as file:
        file.seek(start)
        while block := file.read(min(word_bytes * block_words, left)):
            left -= len(block)
            if (cut := len(block) % word_bytes) and not zeros:
                warnings.warn(f"{path}: ends within an event, it is truncated", stacklevel=4)
            yield block[: len(block) - cut]
    if zeros:
        line = f"{path}: its last {zeros} bytes are zeros, left out: it is truncated"
        warnings.warn(line, stacklevel=4)


def find_end_before_zeros(path: Path, start: int) -> tuple[int, int]:
    """Return how many bytes of a file come from byte `start` on up to its last one that is not 0,
    and how many zeros follow; fewer than LEAST_ZEROS may be of events and belong to the bytes."""
    whole = end = path.stat().st_size
    with path.open("rb") as file:
        while end > start:
            first = max(start, end - BLOCK_BYTES)
            file.seek(first)
            held = len(file.read(end - first).rstrip(b"\0"))
            end = first + held
            if held:
                break
    zeros = whole - end if whole - end >= LEAST_ZEROS else 0
    return max(0, whole - zeros - start), zeros


class TimestampUnwrapper:
    """A counter of `bits`, read in pieces: it went round where it falls by more than half.

    A rise of NEARLY_A_TURN or more after that is a late event, of the round before, where the
    counter falls again within LATE_EVENTS; else it is a silence."""

    def __init__(self, bits: int = 32):
        self._bits, self._last, self._rounds = bits, 0, 0

    def unwrap(self, t: np.ndarray) -> np.ndarray:
        """Return the times (n,) as int64 with the rounds since the first piece."""
        times = t.astype(np.int64)
        if len(times):
            steps, turn = np.diff(times, prepend=self._last), 1 << self._bits
            self._last = int(times[-1])
            falls, rises = steps < -(turn >> 1), steps >= NEARLY_A_TURN * turn
            times += self._count_rounds(falls, _find_late(rises, falls)) * turn
        return times

    def _count_rounds(self, is_next: np.ndarray, is_before: np.ndarray) -> np.ndarray | int:
        """Return the rounds, never below 0, at events that begin the next or go back by one."""
        if not (is_next.any() or (self._rounds and is_before.any())):
            return self._rounds
        rounds = self._rounds + np.cumsum(is_next.astype(np.int64) - is_before)
        rounds -= np.minimum.accumulate(np.minimum(rounds, 0))
        self._rounds = int(rounds[-1])
        return rounds


def _find_late(rises: np.ndarray, falls: np.ndarray) -> np.ndarray:
    """Return the rises after which a counter falls, or the piece ends, within LATE_EVENTS."""
    if not rises.any():
        return rises
    at, ends = np.flatnonzero(rises), np.append(np.flatnonzero(falls), len(falls))
    late = np.zeros_like(rises)
    late[at] = ends[np.searchsorted(ends, at)] - at <= LATE_EVENTS
    return late


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
