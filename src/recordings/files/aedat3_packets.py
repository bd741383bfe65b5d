"""Packets of cAER's AEDAT 3.1 (iniVation's page "AEDAT 3.1")."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import RawEvents
from src.recordings.files.unpacking import LARGEST_PACKET

HEADER = np.dtype(
    [("kind", "<i2"), ("source", "<i2"), ("bytes", "<i4"), ("time_at", "<i4"), ("rounds", "<i4"),
     ("room", "<i4"), ("count", "<i4"), ("valid", "<i4")]
)  # fmt: skip
POLARITY = 1  # kind of a packet of events


def iter_polarity(path: Path, start: int, source: int) -> Iterator[RawEvents]:
    """Yield the valid events of a camera, packet by packet from byte `start`, times in us.

    An event has 32 bits (from the lowest 1 valid, 1 ON, 15 of y, 15 of x) and its time.  Warns of a
    file that ends within a packet.  Raises ValueError for a packet that cannot be, and where only
    packets of other kinds come.
    """
    found, others, left = 0, 0, path.stat().st_size - start
    with path.open("rb") as file:
        file.seek(start)
        while left >= HEADER.itemsize:
            head = np.frombuffer(file.read(HEADER.itemsize), HEADER)[0]
            size = _size(path, head)
            left -= HEADER.itemsize + size
            if left < 0:
                break
            content = file.read(size)
            if head["kind"] == POLARITY and head["source"] == source:
                found += int(head["count"])
                yield _events(content, int(head["rounds"]))
            else:
                others += 1
    if left:
        warnings.warn(f"{path}: ends within a packet, it is truncated", stacklevel=3)
    if others and not found:
        raise ValueError(f"{path}: holds no events, only {others} packets of other kinds")


def _size(path: Path, head: np.void) -> int:
    """Return how many bytes a packet has."""
    size = int(head["bytes"]) * int(head["count"])
    least = 8 if head["kind"] == POLARITY else 0
    if head["bytes"] < least or head["count"] < 0 or not 0 <= size <= LARGEST_PACKET:
        raise ValueError(
            f"{path}: a packet of {head['count']} events of {head['bytes']} bytes cannot be"
        )
    return size


def _events(content: bytes, rounds: int) -> RawEvents:
    words = np.frombuffer(content, "<u4").reshape(-1, 2)
    data, t = words[words[:, 0] & 1 == 1].T
    x, y = (data >> 17).astype(np.uint16), (data >> 2 & 0x7FFF).astype(np.uint16)
    return RawEvents(t.astype(np.int64) + (rounds << 31), x, y, data >> 1 & 1)
