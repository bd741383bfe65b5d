"""Event files, whatever their format, as one structured array: t int64 us, x, y uint16, p int8.

Prophesee EVT2, EVT3 and DAT, AEDAT4 and ES, read and written by faery; CSV and text, npz and HDF5
here.  A file is read in pieces of bounded memory.  What is wrong with a file is an error that names
it, or a warning with the number of events concerned at the end of the reading.
"""

import re
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import faery
import numpy as np
from faery.file_encoder import events_to_file

from src.recordings.files import aedat, columns
from src.recordings.files.engines.decode import adopt
from src.recordings.files.event_arrays import joined, until

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
# Endings read here, by modules with `pieces(path)` and `size(path)` as columns.py has them.
READERS = dict.fromkeys(columns.SUFFIXES, columns)
BINARY = {".raw": "evt", ".dat": "dat", ".aedat4": "aedat", ".es": "es"}
SENSORS = {"gen3": (640, 480), "gen4": (1280, 720), "imx636": (1280, 720), "genx320": (320, 320)}
SIDE_MAX = 2**16  # pixels: coordinates have 16 bits
HIGHEST = 2**62  # microseconds; a time beyond is a broken file
SILENCE_US = 2**24  # EVT3 counts time in 24 bits: the writer cannot bridge a longer silence
DAT_SPAN_US = 2**32
PIECE = 2**18  # events in a written piece


@dataclass(frozen=True)
class Recording:
    """An event file: `size` is its (width, height) in pixels, None where the file does not say."""

    path: Path
    size: tuple[int, int] | None

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield the events in pieces, not empty, in order of time; warn of what was wrong."""
        last, back, outside = -HIGHEST, 0, 0
        width, height = self.size or (0, 0)
        for t, x, y, p in _pieces(self.path):
            if len(t) and not -HIGHEST < int(t[0]) < HIGHEST:
                raise ValueError(f"{self.path}: event times are broken, the first is {t[0]} us")
            events = np.empty(len(t), EVENT)
            kept, last, went, out = adopt(t, x, y, p, width, height, last, events)
            back, outside = back + went, outside + out
            if kept:
                yield events[:kept]
        if back:
            warnings.warn(f"{self.path}: {back} events went back in time, held", stacklevel=2)
        if outside:
            warnings.warn(
                f"{self.path}: {outside} events outside {width}x{height}, dropped", stacklevel=2
            )


def open_events(path: str | Path, size: tuple[int, int] | None = None) -> Recording:
    """Return the recording at `path`; `size` (width, height) for a file that does not say.

    Raises ValueError for a file that is missing, empty or of an unknown kind.
    """
    path = Path(path)
    if not path.is_file() or path.stat().st_size == 0:
        raise ValueError(f"{path}: {'the file is empty' if path.is_file() else 'no such file'}")
    if path.suffix not in (*BINARY, *READERS):
        kinds = ", ".join((*BINARY, *READERS))
        raise ValueError(f"{path}: unknown kind of event file, known are {kinds}")
    size = _size(path) or size
    if size is not None and not all(1 <= side <= SIDE_MAX for side in size):
        raise ValueError(f"{path}: a sensor's sides must be in 1..{SIDE_MAX}, got {size}")
    return Recording(path, size)


def read_events(path: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return all events of a file: t int64 us, x, y uint16, p int8 in {-1, 1}, in order of time.

    Raises ValueError for a file that cannot be read; warns of events that go back in time (they
    are given the latest time so far) and of events outside the sensor (they are dropped).
    """
    pieces = list(open_events(path, size))
    return joined(pieces) if pieces else np.empty(0, EVENT)


def iter_events(
    path: str | Path, *, seconds: float = 0.1, size: tuple[int, int] | None = None
) -> Iterator[np.ndarray]:
    """Yield the events of a file in chunks of `seconds`, counted from the first event.

    A span without events yields nothing, however long it is.  Memory is that of one chunk and one
    piece of the decoder.  Raises as `read_events` does.
    """
    if not 1e-6 <= seconds <= 1e6:
        raise ValueError(f"seconds must be in [1e-6, 1e6], got {seconds}")
    span, start, held = round(seconds * 1e6), None, []
    for events in open_events(path, size):
        start = int(events["t"][0]) if start is None else start
        while len(events):
            cut = until(events, start + span)
            held.append(events[:cut])
            events = events[cut:]
            if len(events):
                chunk = joined(held)
                if len(chunk):
                    yield chunk
                held, start = [], start + (int(events["t"][0]) - start) // span * span
    if held:
        yield joined(held)


def write_events(
    path: str | Path, events: np.ndarray, *, width: int, height: int, version: str = "evt3"
) -> None:
    """Write events (t, x, y, p, in order of time) in the format of the path's ending.

    `version` is `evt2` or `evt3` for `.raw`.  Raises ValueError for events that are out of order or
    off the sensor, a polarity that is not -1 or 1, and times that the format cannot hold.
    """
    path = Path(path)
    t, x, y, p = (events[name] for name in "txyp")
    _check_writable(path, t, x, y, p, width, height, version)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix in columns.SUFFIXES:
        columns.write(path, events, (width, height))
        return
    listed = np.empty(len(events), faery.EVENTS_DTYPE)
    listed["t"], listed["x"], listed["y"], listed["on"] = t, x, y, p > 0
    pieces = (listed[i : i + PIECE] for i in range(0, max(len(listed), 1), PIECE))
    numbers = {".raw": version, ".dat": "dat2"}
    kind = BINARY[path.suffix]
    events_to_file(
        pieces, path, (width, height), version=numbers.get(path.suffix), file_type=kind,
        zero_t0=path.suffix != ".es",
    )  # fmt: skip


def _check_writable(path, t, x, y, p, width, height, version) -> None:
    if path.suffix not in (*BINARY, *columns.SUFFIXES) or version not in ("evt2", "evt3"):
        raise ValueError(f"{path}: cannot write {path.suffix or 'no ending'} of version {version}")
    if len(t) == 0:
        return
    gaps = np.diff(t)
    if t[0] < 0 or (gaps < 0).any():
        raise ValueError(f"{path}: times must start at 0 or later and not decrease")
    if x.max() >= width or y.max() >= height:
        raise ValueError(f"{path}: events must lie on {width}x{height}, got {x.max()}, {y.max()}")
    if not np.isin(p, (-1, 1)).all():
        raise ValueError(f"{path}: polarity must be -1 or 1, got {np.unique(p)[:4].tolist()}")
    if path.suffix == ".raw" and version == "evt3" and (gaps >= SILENCE_US).any():
        raise ValueError(f"{path}: EVT3 cannot hold a silence of {gaps.max()} us, use evt2")
    if path.suffix == ".dat" and t[-1] - t[0] >= DAT_SPAN_US:
        raise ValueError(f"{path}: DAT cannot hold {t[-1] - t[0]} us, use evt2")


def _pieces(path: Path) -> Iterator[tuple]:
    """Yield (t, x, y, p) of a file piece by piece; p is ON where positive."""
    if path.suffix in READERS:
        yield from READERS[path.suffix].pieces(path)
        return
    if path.suffix in (".raw", ".dat") and len(_header(path)) == path.stat().st_size:
        return  # a recording without events
    if path.suffix == ".aedat4":
        aedat.check_packets(path)
    for events in _decoded(path, _decoder(path)):
        yield events["t"].view(np.int64), events["x"], events["y"], events["on"]


def _decoder(path: Path) -> Iterable[np.ndarray]:
    kind = BINARY[path.suffix]
    fallback = None
    if kind == "evt":
        version, words = _evt_version(path), path.stat().st_size - len(_header(path))
        fallback = f"evt{version[0]}"
        if words % (4 if fallback == "evt2" else 2):
            warnings.warn(f"{path}: the file ends within a word, it is truncated", stacklevel=2)
    if kind == "aedat":
        aedat.check_header(path)
    return _guarded(
        path,
        lambda: faery.events_stream_from_file(
            path, file_type=kind, version_fallback=fallback, dimensions_fallback=(65535, 65535)
        ),
    )


def _decoded(path: Path, stream: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield what the decoder yields; its errors, panics of compiled code too, name the file."""
    pieces = iter(stream)
    while True:
        piece = _guarded(path, lambda: next(pieces, None))
        if piece is None:
            return
        yield piece


def _guarded(path: Path, call):
    try:
        return call()
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:  # a panic of the decoder is no Exception
        raise ValueError(f"{path}: cannot be decoded: {error}") from error


def _header(path: Path) -> bytes:
    """Return the header of a Prophesee file: its first lines, those that begin with `% `."""
    with path.open("rb") as file:
        start = file.read(1 << 16)
    lines = re.match(rb"(?:% (?!end)[^\n]*\n)*(?:% end[^\n]*\n)?", start)
    return lines.group() if lines else b""


def _evt_version(path: Path) -> str:
    header = _header(path).decode("latin-1").lower()
    match = re.search(r"% (?:evt (\d(?:\.\d)?)|format evt(\d+))", header)
    if not match:
        raise ValueError(f"{path}: no `% evt` line in its header, this is no EVT2 or EVT3 file")
    version = (match.group(1) or match.group(2)).replace(".0", "")
    if version not in ("2", "3"):
        raise ValueError(
            f"{path}: EVT {version} is not read, its byte order differs between cameras; "
            "export the recording as EVT3 or EVT2 (metavision_file_to_raw or the camera's settings)"
        )
    return version


def _size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) as the file states it, or None."""
    if path.suffix in READERS:
        return READERS[path.suffix].size(path)
    if path.suffix in (".es", ".aedat4"):
        return _decoder(path).dimensions()
    header = _header(path).decode("latin-1").lower()
    wide = re.search(r"(?:geometry[ :]|width[ =])(\d+)(?:x|;height=|[^%]*% height )(\d+)", header)
    if wide:
        return int(wide.group(1)), int(wide.group(2))
    name = re.search(r"gen3|gen4|imx636|genx320", header)
    return SENSORS[name.group()] if name else None
