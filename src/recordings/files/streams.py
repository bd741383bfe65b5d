"""Several cameras in one file: which of them is read, and what the user is told of the others."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple


class EventStream(NamedTuple):
    """Events of one camera: its number in the file, its name, and (width, height) or None."""

    id: int
    name: str
    size: tuple[int, int] | None


def choose_stream(
    path: Path, streams: Sequence[EventStream], wanted: str | int | None, default: int = 0
) -> tuple[EventStream, tuple[str, ...]]:
    """Return the stream `wanted`, its place in `streams` or its name, and a note of the others.

    Without `wanted` it is `streams[default]`.  Raises ValueError where there is no such stream.
    """
    names = ", ".join(f"{place} ({stream.name})" for place, stream in enumerate(streams))
    if wanted is None:
        place = default
    else:
        known = {stream.name: place for place, stream in reversed(list(enumerate(streams)))}
        known |= {str(place): place for place in range(len(streams))}
        if str(wanted) not in known:
            raise ValueError(f"{path}: stream must be one of {names}, got {wanted}")
        place = known[str(wanted)]
    note = f"{path}: holds {len(streams)} event streams, {names}; read is {place} (stream={place})"
    return streams[place], (note,) if len(streams) > 1 else ()
