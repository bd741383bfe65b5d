"""Event files read piece by piece as a reader gives them, and compared with what was written."""

from pathlib import Path

import numpy as np

from src.recordings.files.event_file import EventFile, RawEvents, ReadOptions


def read(
    kind: type[EventFile], path: Path, content: bytes | None = None, **options
) -> tuple[EventFile, RawEvents]:
    """Return the file at `path`, of `content` if given, and all its events."""
    if content is not None:
        path.write_bytes(content)
    file = kind(path, ReadOptions(**options))
    return file, RawEvents(*map(np.concatenate, zip(*file.pieces(), strict=True)))


def equal(found: RawEvents, events: np.ndarray) -> bool:
    columns = [np.array_equal(getattr(found, name), events[name]) for name in "txy"]
    return all(columns) and np.array_equal(np.asarray(found.p) > 0, events["p"] > 0)
