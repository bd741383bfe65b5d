"""What a format's reader gives to the recording that is read from it."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
UNITS_US = {"s": 1e6, "ms": 1e3, "us": 1.0, "ns": 1e-3}
TIME_UNITS = ("auto", *UNITS_US)
RAW_FORMATS = ("evt2", "evt21", "evt3")
PIECE_EVENTS = 2**18  # events in a piece
HeightWidth = tuple[int, int]
WidthHeight = tuple[int, int]


@dataclass(frozen=True)
class ReadOptions:
    """What the user states of a file that does not say it, or of which it has several.

    `time_unit`: auto, s, ms, us or ns.  `columns`: the order of the columns of a table,
    the letters x y p t (other letters are skipped); names in the file do not count then, nor a unit
    in them.  `format`: of a RAW file without a line that says it: evt2, evt21 or evt3.  `stream`:
    number or name of one of several cameras in a file.  `part`: 0, 1, ... of a file whose clock
    restarts.  Raises ValueError for a value out of range or of another kind; reading does for one
    that the file has no use for.
    """

    time_unit: str = "auto"
    columns: str | None = None
    format: str | None = None
    stream: str | int | None = None
    part: int | None = None

    def __post_init__(self):
        _check_option_kinds({field.name: getattr(self, field.name) for field in fields(self)})
        if self.time_unit not in TIME_UNITS:
            raise ValueError(f"time_unit must be auto, s, ms, us or ns, got {self.time_unit}")
        order = self.columns
        if order is not None and any(order.count(name) != 1 for name in "txyp"):
            raise ValueError(f"columns must have t, x, y and p once each, got {order}")
        if self.format not in (None, *RAW_FORMATS):
            raise ValueError(f"format must be null, {', '.join(RAW_FORMATS)}, got {self.format}")
        if self.part is not None and self.part < 0:
            raise ValueError(f"part must be null or a whole number from 0 on, got {self.part}")

    @classmethod
    def from_keys(cls, cfg: Mapping) -> "ReadOptions":
        """Return the options from the keys of a config that have their names; raises ValueError
        for one of another kind."""
        given = {field.name: cfg[field.name] for field in fields(cls)}
        _check_option_kinds(given)
        return cls(**given)


def _check_option_kinds(given: Mapping[str, Any]) -> None:
    for name, value in given.items():
        kinds = {"part": (int,), "stream": (int, str)}.get(name, (str,))
        if value is not None and type(value) not in kinds:
            expected = {"part": "a whole number", "stream": "a number or a name"}
            raise ValueError(f"{name} must be {expected.get(name, 'a word')}, got {value}")


class RawEvents(NamedTuple):
    """Events as a file has them, in its order: `t` int64 or float64 in the file's unit; `x`, `y`
    integers; `p` is ON where positive.  Each is (n,)."""

    t: np.ndarray
    x: np.ndarray
    y: np.ndarray
    p: np.ndarray


class RawFrames(NamedTuple):
    """Frames of a camera beside the event pixels, as a file has them: times `t` (n,) in `unit`,
    None: that of the events; `size`: (height, width); `pictures()` yields them, uint8 (h, w)."""

    t: np.ndarray
    size: HeightWidth
    pictures: Callable[[], Iterator[np.ndarray]]
    unit: str | None = None


class EventStream(NamedTuple):
    """Events of one camera: its number in the file, its name, and (width, height) or None."""

    id: int
    name: str
    size: WidthHeight | None


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


def require_default_stream(path: Path, wanted: str | int | None) -> None:
    """Raise ValueError for a stream other than the first of a file that holds one only."""
    if wanted not in (None, 0, "0"):
        raise ValueError(f"stream must be null, as {path} has one camera, got {wanted}")


def refuse_column_order(order: str | None, why: str) -> None:
    """Raise ValueError for an order (columns=) where columns have none, for the reason `why`."""
    if order is not None:
        raise ValueError(f"columns must be null, as {why}, got {order}")


@contextmanager
def name_file_in_errors(path: Path, wrong: str) -> Iterator[None]:
    """Raise every error of the block, a panic of compiled code too, as a ValueError of one line,
    `{path}: {wrong}: {error}`; one that begins with the path keeps its text."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        raise
    except BaseException as error:
        text = str(error).split("\n")[0] or type(error).__name__
        whole = text if text.startswith(f"{path}: ") else f"{path}: {wrong}: {text}"
        raise ValueError(whole) from error


class EventFile(ABC):
    """An event file of one format, opened with a `path` and ReadOptions.

    `size`: (width, height) in pixels, None where the file does not state it.  `time_unit`: s, ms,
    us or ns where the format defines it, None where its values must tell.  `notes`: lines for the
    user, such as which other streams the file holds.  `kept_times`: what `times` yields, where it
    was read and kept: `pieces` may take its times from there.  Opening and reading raise
    ValueError, which names the file, for what cannot be read.
    """

    path: Path
    size: WidthHeight | None = None
    time_unit: str | None = None
    notes: tuple[str, ...] = ()
    kept_times: list[np.ndarray] | None = None

    def use_sensor_size(self, size: WidthHeight | None) -> None:
        """Take the (width, height) that the user states, None where they state none: for a file
        that does not, but counts places from the far sides."""
        return

    @abstractmethod
    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events in pieces of about PIECE_EVENTS, each time from the beginning."""

    def times(self) -> Iterator[np.ndarray] | None:
        """Yield the times alone, in pieces, as `pieces` has them; None where this would cost as
        much as `pieces`: then order is judged while events are read."""
        return None

    def frames(self) -> RawFrames | None:
        """Return the frames of a camera that the recording has beside its events, None for none."""
        return None
