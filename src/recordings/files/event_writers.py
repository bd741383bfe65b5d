"""Events to files of other tools, piece by piece, so that a recording of any length fits.

RAW (EVT2, EVT3), DAT, AEDAT4 and ES are written by faery; CSV, npz, HDF5 and EVREAL's folder of
.npy in table_writers.py.  Until it is whole a file has `partial` in its name.
"""

import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from src.recordings.files import table_writers
from src.recordings.files.event_file import PIECE_EVENTS, WidthHeight
from src.recordings.files.recorded_frames import RecordedFrames
from src.recordings.sensor_limits import LARGEST_SIDE
from src.records.atomic import name_path_in_errors, partial_path

BINARY = {".raw": "evt", ".dat": "dat", ".aedat4": "aedat", ".es": "es"}
TABLES: dict[str, Callable] = {
    ".csv": table_writers.write_csv, ".npz": table_writers.write_npz,
    ".h5": table_writers.write_dsec, ".hdf5": table_writers.write_dsec,
    "evreal": table_writers.write_evreal,
}  # fmt: skip
VERSIONS = (None, "evt2", "evt3")
LAYOUTS = (None, "evreal")
RAW_MOST_PIXELS = 2**11  # of a side, by its bits
MOST_US = {".dat": 2**32, ".h5": 2**32, ".hdf5": 2**32}  # between the first and the last event
MOST_ES_US = 2**32  # ES writes all time since 0, a byte for each 127 us without events
# RAW counts time in 24 and 34 bits; that it went round shows where it falls by more than half.
OS_ERROR = re.compile(r"\(os error (\d+)\)")
MOST_SILENCE_US = {"evt3": 2**23, "evt2": 2**33}


def write_events(
    path: str | Path, events: np.ndarray, *, width: int, height: int, version: str | None = None
) -> None:
    """Write events (n,) of t, x, y, p, in order of time, in the format of the path's ending.

    Whole numbers, t in us.  `width`, `height`: of the sensor in pixels; `version`: evt2 or evt3
    (None), of a `.raw`.  Raises ValueError for other numbers, events that are out of order or off
    the sensor, a polarity that is not -1 or 1, and what the format cannot hold.
    """
    starts = range(0, len(events), PIECE_EVENTS)
    pieces = (events[start : start + PIECE_EVENTS] for start in starts)
    write_pieces(path, pieces, width=width, height=height, version=version)


def write_pieces(
    path: str | Path,
    pieces: Iterable[np.ndarray],
    *,
    width: int,
    height: int,
    version: str | None = None,
    layout: str | None = None,
    frames: RecordedFrames | None = None,
) -> tuple[int, float]:
    """Write events that come in pieces, as `write_events`; return how many, and their seconds.

    `layout` evreal writes a folder, as EVREAL reads it, with `frames` of the sensor's size.
    """
    path = Path(path)
    kind = choose_file_kind(path, layout, width, height, version)
    version = version or "evt3"
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = partial_path(path)
    _remove(partial)
    checked = _Checked(path, kind, pieces, (width, height), version)
    try:
        with name_path_in_errors(path):
            if kind in BINARY:
                _write_binary(partial, kind, iter(checked), (width, height), version)
            else:
                given = {"frames": frames} if kind == "evreal" else {}
                TABLES[kind](partial, iter(checked), (width, height), **given)
        if kind == "evreal":
            _remove(path)
        os.replace(partial, path)
    finally:
        _remove(partial)
    return checked.count, checked.span_us * 1e-6


def choose_file_kind(
    path: Path, layout: str | None, width: int, height: int, version: str | None = None,
    config_key: str = "path",
) -> str:  # fmt: skip
    """Return the ending that says how `path` is written, or evreal; raises ValueError, which names
    `config_key`, for what cannot be, before anything is written."""
    suffix = path.suffix.lower()
    if layout not in LAYOUTS:
        raise ValueError(f"layout must be null or evreal, got {layout}")
    if version not in VERSIONS:
        raise ValueError(f"version must be null, evt2 or evt3, got {version}")
    kind = "evreal" if layout == "evreal" else suffix
    if kind not in (known := (*BINARY, *TABLES)):
        endings = ", ".join(name for name in known if name[0] == ".")
        raise ValueError(f"{config_key} must end in one of {endings}, got {path}")
    if version is not None and kind != ".raw":
        raise ValueError(f"version must be null, as {path} is no RAW file, got {version}")
    if path.is_dir():
        present = {file.name for file in path.iterdir()}
        if kind != "evreal" or table_writers.EVREAL_TIMES not in present:
            raise ValueError(f"{path}: is a folder already, of something else")
        if more := present - table_writers.EVREAL_FILES:
            raise ValueError(f"{path}: must hold no other files than EVREAL's, got {min(more)}")
    if kind == "evreal" and path.is_file():
        raise ValueError(f"{path}: layout=evreal writes a folder, this is a file already")
    if max(width, height) > (most := RAW_MOST_PIXELS if kind == ".raw" else LARGEST_SIDE):
        raise ValueError(f"{path}: {kind} holds sides up to {most}, got {width}x{height}")
    return kind


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)


class _Checked:
    """Pieces that can be written; `count` and `span_us` are of those that came so far."""

    def __init__(self, path: Path, kind: str, pieces: Iterable, size: WidthHeight, version: str):
        self.count, self.span_us = 0, 0
        self._path, self._kind, self._pieces, self._size = path, kind, pieces, size
        self._silence_us = MOST_SILENCE_US[version] if kind == ".raw" else 2**62
        self._version = version.upper()

    def __iter__(self) -> Iterator[np.ndarray]:
        first, last = 0, 0
        for events in self._pieces:
            if len(events):
                first = first if self.count else int(events["t"][0])
                self._check_pixels(events)
                self._check_times(events["t"], last if self.count else first, first)
                last = int(events["t"][-1])
                self.count, self.span_us = self.count + len(events), last - first
                yield events

    def _check_times(self, t: np.ndarray, last: int, first: int) -> None:
        gaps = np.diff(t, prepend=last)
        if (t[0] < 0 and self._kind != "evreal") or (gaps < 0).any():
            raise ValueError(f"{self._path}: times must start at 0 or later and not decrease")
        if (gaps >= self._silence_us).any():
            raise ValueError(
                f"{self._path}: {self._version} cannot hold a silence of {gaps.max()} us, use "
                f"{'version=evt2' if self._version == 'EVT3' else '.npz'}"
            )
        if self._kind == ".es" and t[-1] >= MOST_ES_US:
            raise ValueError(f"{self._path}: .es cannot hold a time of {t[-1]} us, use .npz")
        if (span := int(t[-1]) - first) >= MOST_US.get(self._kind, 2**62):
            raise ValueError(f"{self._path}: {self._kind} cannot hold {span} us, use .npz")

    def _check_pixels(self, events: np.ndarray) -> None:
        (width, height), x, y, p = self._size, events["x"], events["y"], events["p"]
        kinds = {name: events[name].dtype for name in "txyp"}
        if not all(kind.kind in "iu" for kind in kinds.values()):
            got = ", ".join(f"{name} {kind}" for name, kind in kinds.items())
            raise ValueError(f"{self._path}: t (us), x, y, p must be whole numbers, got {got}")
        for place, side in ((x, width), (y, height)):
            if place.min() < 0 or place.max() >= side:
                got = f"x in {x.min()}..{x.max()}, y in {y.min()}..{y.max()}"
                raise ValueError(f"{self._path}: events must lie on {width}x{height}, got {got}")
        if not np.isin(p, (-1, 1)).all():
            raise ValueError(
                f"{self._path}: polarity must be -1 or 1, got {np.unique(p)[:4].tolist()}"
            )


def _write_binary(
    path: Path, kind: str, pieces: Iterator[np.ndarray], size: WidthHeight, version: str
) -> None:
    import faery  # here, as in es_file.py
    from faery.file_encoder import events_to_file

    number = {".raw": version, ".dat": "dat2"}.get(kind)
    how = {"file_type": BINARY[kind], "zero_t0": kind != ".es", "use_write_suffix": False}
    listed = (_as_faery(events, faery.EVENTS_DTYPE) for events in pieces)
    try:
        events_to_file(listed, path, size, version=number, **how)
    except RuntimeError as error:  # of faery's encoders, for one of the disk
        if (found := OS_ERROR.search(str(error))) is None:
            raise
        raise OSError(int(found[1]), str(error)) from error


def _as_faery(events: np.ndarray, kind: np.dtype) -> np.ndarray:
    listed = np.empty(len(events), kind)
    for name in "txy":
        listed[name] = events[name]
    listed["on"] = events["p"] > 0
    return listed
