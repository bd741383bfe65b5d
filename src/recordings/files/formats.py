"""Event files, whatever their format, as one structured array: t int64 us, x, y uint16, p int8.

Prophesee EVT2, EVT3 and DAT, AEDAT4 and ES, read and written by faery; CSV, text, npz and HDF5,
read here.  What is wrong with a file is an error that names it, or a warning with the number of
events concerned at the end of the reading.
"""

import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import faery
import numpy as np
from faery.file_encoder import events_to_file

from src.recordings.engines.event_passes import convert_events
from src.recordings.files import aedat, columns
from src.recordings.files.event_arrays import concatenate_events, count_before

EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])
# Endings read by modules with `iter_event_pieces` and `read_sensor_size`, as columns.py.
READERS = dict.fromkeys(columns.SUFFIXES, columns)
BINARY = {".raw": "evt", ".dat": "dat", ".aedat4": "aedat", ".es": "es"}
SENSORS = {"gen3": (640, 480), "gen4": (1280, 720), "imx636": (1280, 720), "genx320": (320, 320)}
MAX_SIDE = 2**16  # pixels: coordinates have 16 bits
MAX_TIME_US = 2**62  # microseconds; a time beyond is a broken file
EVT3_MAX_GAP_US = 2**24  # EVT3 counts time in 24 bits: the writer cannot bridge a longer silence
DAT_SPAN_US = 2**32
PIECE_EVENTS = 2**18  # events in a written piece


@dataclass(frozen=True)
class EventRecording:
    """An event file: `size` is its (width, height) in pixels, None where the file does not say."""

    path: Path
    size: tuple[int, int] | None

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield the events in pieces, not empty, in order of time; warn of what was wrong."""
        last, back, outside = -MAX_TIME_US, 0, 0
        width, height = self.size or (0, 0)
        for t, x, y, p in _pieces(self.path):
            if len(t) and not -MAX_TIME_US < int(t[0]) < MAX_TIME_US:
                raise ValueError(f"{self.path}: event times are broken, the first is {t[0]} us")
            events = np.empty(len(t), EVENT)
            kept, last, went, out = convert_events(t, x, y, p, width, height, last, events)
            back, outside = back + went, outside + out
            if kept:
                yield events[:kept]
        if back:
            warnings.warn(f"{self.path}: {back} events went back in time, held", stacklevel=2)
        if outside:
            warnings.warn(
                f"{self.path}: {outside} events outside {width}x{height}, dropped", stacklevel=2
            )


def open_recording(path: str | Path, size: tuple[int, int] | None = None) -> EventRecording:
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
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        raise ValueError(f"{path}: a sensor's sides must be in 1..{MAX_SIDE}, got {size}")
    return EventRecording(path, size)


def read_events(path: str | Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """Return all events of a file: t int64 us, x, y uint16, p int8 in {-1, 1}, in order of time.

    Raises ValueError for a file that cannot be read; warns of events that go back in time (held at
    the latest time so far) and of events outside the sensor (dropped).
    """
    pieces = list(open_recording(path, size))
    return concatenate_events(pieces) if pieces else np.empty(0, EVENT)


def iter_events(
    path: str | Path, *, seconds: float = 0.1, size: tuple[int, int] | None = None
) -> Iterator[np.ndarray]:
    """Yield the events of a file in chunks of `seconds` from the first event, those without events
    left out, in the memory of one chunk.  Raises as `read_events` does."""
    if not 1e-6 <= seconds <= 1e6:
        raise ValueError(f"seconds must be in [1e-6, 1e6], got {seconds}")
    span, start, held = round(seconds * 1e6), None, []
    for events in open_recording(path, size):
        start = int(events["t"][0]) if start is None else start
        while len(events):
            cut = count_before(events, start + span)
            held.append(events[:cut])
            events = events[cut:]
            if len(events):
                chunk = concatenate_events(held)
                if len(chunk):
                    yield chunk
                held, start = [], start + (int(events["t"][0]) - start) // span * span
    if held:
        yield concatenate_events(held)


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
    listed = np.empty(len(events), faery.EVENTS_DTYPE)
    listed["t"], listed["x"], listed["y"], listed["on"] = t, x, y, p > 0
    pieces = (listed[i : i + PIECE_EVENTS] for i in range(0, max(len(listed), 1), PIECE_EVENTS))
    number = {".raw": version, ".dat": "dat2"}.get(path.suffix)
    how = {"file_type": BINARY[path.suffix], "zero_t0": path.suffix != ".es"}
    events_to_file(pieces, path, (width, height), version=number, **how)


def _check_writable(path, t, x, y, p, width, height, version) -> None:
    if path.suffix not in BINARY or version not in ("evt2", "evt3"):
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
    if path.suffix == ".raw" and version == "evt3" and (gaps >= EVT3_MAX_GAP_US).any():
        raise ValueError(f"{path}: EVT3 cannot hold a silence of {gaps.max()} us, use evt2")
    if path.suffix == ".dat" and t[-1] - t[0] >= DAT_SPAN_US:
        raise ValueError(f"{path}: DAT cannot hold {t[-1] - t[0]} us, use evt2")


def _pieces(path: Path) -> Iterator[tuple]:
    """Yield (t, x, y, p) of a file piece by piece; p is ON where positive."""
    if path.suffix in READERS:
        yield from READERS[path.suffix].iter_event_pieces(path)
        return
    if path.suffix in (".raw", ".dat") and len(_header(path)) == path.stat().st_size:
        return  # a recording without events
    if path.suffix == ".aedat4":
        aedat.check_packets(path)
    pieces = iter(_decoder(path))
    while True:
        with _guarded(path):
            events = next(pieces, None)
        if events is None:
            return
        yield events["t"].view(np.int64), events["x"], events["y"], events["on"]


def _decoder(path: Path) -> Any:
    kind = BINARY[path.suffix]
    fallback = None
    if kind == "evt":
        version, words = _evt_version(path), path.stat().st_size - len(_header(path))
        fallback = f"evt{version[0]}"
        if words % (4 if fallback == "evt2" else 2):
            warnings.warn(f"{path}: the file ends within a word, it is truncated", stacklevel=2)
    if kind == "aedat":
        aedat.check_header(path)
    fallbacks = {"version_fallback": fallback, "dimensions_fallback": (65535, 65535)}
    with _guarded(path):
        return faery.events_stream_from_file(path, file_type=kind, **fallbacks)


@contextmanager
def _guarded(path: Path) -> Iterator[None]:
    """Errors of the decoder, panics of compiled code too, which are no Exception, name the file."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:
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
        return READERS[path.suffix].read_sensor_size(path)
    if path.suffix in (".es", ".aedat4"):
        return _decoder(path).dimensions()
    header = _header(path).decode("latin-1").lower()
    wide = re.search(r"(?:geometry[ :]|width[ =])(\d+)(?:x|;height=|[^%]*% height )(\d+)", header)
    if wide:
        return int(wide.group(1)), int(wide.group(2))
    name = re.search(r"gen3|gen4|imx636|genx320", header)
    return SENSORS[name.group()] if name else None
