"""Blocks of a file: its whole words, and small pieces of events joined to larger ones."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import PIECE_EVENTS, RawEvents

BLOCK_BYTES = 2**20
LEAST_ZEROS = 64  # bytes at the end that are no events, but were never written


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


def merge_small_pieces(pieces: Iterator[RawEvents]) -> Iterator[RawEvents]:
    """Yield the events in pieces of PIECE_EVENTS or more, the last one apart; none is empty."""
    held: list[RawEvents] = []
    for piece in pieces:
        held.append(piece)
        if sum(len(part.t) for part in held) >= PIECE_EVENTS:
            yield _join(held)
            held = []
    if any(len(part.t) for part in held):
        yield _join(held)


def _join(pieces: list[RawEvents]) -> RawEvents:
    return RawEvents(*map(np.concatenate, zip(*pieces, strict=True)))
