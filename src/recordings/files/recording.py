"""Event files of any format as one structured array: t int64 us, x, y uint16, p int8.

What is wrong with a file is an error that names it, or a warning with the number of events
concerned.
"""

import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from src.recordings.engines.event_passes import convert_events
from src.recordings.files.aedat2_file import Aedat2File
from src.recordings.files.aedat4_file import Aedat4File
from src.recordings.files.array_file import ArrayFile
from src.recordings.files.es_file import EsFile
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.files.event_file import EVENT, EventFile, RawEvents, ReadOptions
from src.recordings.files.event_order import EventSorter, merge_in_time
from src.recordings.files.evreal_folder import EvrealFolder, is_evreal_folder
from src.recordings.files.hdf5_file import HDF5_ENDINGS, Hdf5File
from src.recordings.files.npz_folder import NpzFolder, find_npz_folder
from src.recordings.files.prophesee_file import PropheseeFile
from src.recordings.files.rosbag_file import RosbagFile, is_bag_folder
from src.recordings.files.survey import TimeSurvey, survey_times
from src.recordings.files.text_file import TextFile
from src.recordings.files.text_layout import TEXT_ENDINGS
from src.recordings.files.time_unit import check_times, to_us

Reader = Callable[[Path, ReadOptions], EventFile]
READERS: dict[str, Reader] = {  # by the ending, in small letters
    ".raw": PropheseeFile, ".dat": PropheseeFile, ".aedat4": Aedat4File, ".aedat": Aedat2File,
    ".es": EsFile, ".bag": RosbagFile, ".db3": RosbagFile, ".mcap": RosbagFile, ".npy": ArrayFile,
    ".npz": ArrayFile, **dict.fromkeys(HDF5_ENDINGS, Hdf5File),
    **dict.fromkeys((*TEXT_ENDINGS, ".gz", ".zip"), TextFile),
}  # fmt: skip
OF_ONE_CAMERA = (PropheseeFile, EsFile, TextFile)
MAX_SIDE = 2**16  # pixels: coordinates have 16 bits


@dataclass(frozen=True)
class EventRecording:
    """An event file: `size` is its (width, height) in pixels, None where the file does not say."""

    path: Path
    size: tuple[int, int] | None
    options: ReadOptions
    file: EventFile
    survey: TimeSurvey

    @property
    def messages(self) -> tuple[str, ...]:
        """Return what the user is told before the file is read."""
        return *self.file.notes, *self.survey.messages

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield the events in pieces, not empty, in order of time; warn of what was wrong."""
        if self.survey.parts_are_on_and_off:
            both = (iter(_Reading(self, part)) for part in (0, 1))
            yield from merge_in_time(*both)
        else:
            yield from _Reading(self, self.options.part or 0)


def open_recording(
    path: str | Path, size: tuple[int, int] | None = None, options: ReadOptions = ReadOptions()
) -> EventRecording:
    """Return the recording at `path`; `size` (width, height) for a file that does not say.

    Of a table all times are read here, and what is odd about their unit or order is a warning.
    Raises ValueError for a file that is missing, empty, of an unknown kind or cannot be read.
    """
    path = Path(path)
    if find_folder_reader(path) is None and (not path.is_file() or path.stat().st_size == 0):
        found = "is a folder, not an event file" if path.is_dir() else "no such file"
        raise ValueError(f"{path}: {'the file is empty' if path.is_file() else found}")
    state = path.stat()
    kept, survey = _open_and_survey(path, state.st_mtime_ns, state.st_size, options)
    file = _open_file(path, options) if kept is None else kept
    file.kept_times = survey.times
    size = file.size or size
    if size is not None and not all(1 <= side <= MAX_SIDE for side in size):
        raise ValueError(f"{path}: a sensor's sides must be in 1..{MAX_SIDE}, got {size}")
    recording = EventRecording(path, size, options, file, survey)
    _tell(recording.messages)
    return recording


def read_events(
    path: str | Path, size: tuple[int, int] | None = None, options: ReadOptions = ReadOptions()
) -> np.ndarray:
    """Return all events of a file, (n,) of t int64 us, x, y uint16, p int8 in {-1, 1}, in order of
    time.

    `size`: (width, height) for a file that does not state it; without it no event is off the
    sensor.  `options`: what the file does not say (ReadOptions).  Raises ValueError for a file that
    cannot be read; warns of what was sorted or dropped, with the number of events.
    """
    pieces = list(open_recording(path, size, options))
    return concatenate_events(pieces) if pieces else np.empty(0, EVENT)


def iter_events(
    path: str | Path,
    *,
    seconds: float = 0.1,
    size: tuple[int, int] | None = None,
    options: ReadOptions = ReadOptions(),
) -> Iterator[np.ndarray]:
    """Yield the events of a file in chunks of `seconds` from the first event, those without events
    left out, in the memory of one chunk.  Raises as `read_events` does."""
    if not 1e-6 <= seconds <= 1e6:
        raise ValueError(f"seconds must be in [1e-6, 1e6], got {seconds}")
    span, start, held = round(seconds * 1e6), None, []
    for events in open_recording(path, size, options):
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


class _Reading:
    """The events of one part of a recording; the numbers are of those that came so far."""

    def __init__(self, recording: EventRecording, part: int):
        self._recording, self._path, self._part = recording, recording.path, part
        survey = recording.survey
        self._order = EventSorter(survey.buffer_us, survey.min_part_events, part)
        self._count, self._outside, self._most = 0, 0, np.zeros(2, np.int64)

    def __iter__(self) -> Iterator[np.ndarray]:
        if self._recording.survey.is_ordered and self._part == 0:
            yield from filter(len, self._converted())
        else:
            for events in self._converted():
                yield from filter(len, self._order.add(events))
                self._check(2**20)
            yield from filter(len, self._order.finish())
            self._check()
        self._tell_at_end()

    def _converted(self) -> Iterator[np.ndarray]:
        """Yield the events on the sensor as the file has them."""
        width, height = self._recording.size or (0, 0)
        recording = self._recording
        for raw in recording.survey.pieces or recording.file.pieces():
            unit = recording.survey.unit
            if not recording.survey.covers_all_times and (raw.t.dtype != np.int64 or unit != "us"):
                check_times(raw.t, unit, self._path)
            t = to_us(raw.t, unit)
            x, y, p = _plain(raw)
            events = np.empty(len(t), EVENT)
            found = convert_events(t, x, y, p, width, height, self._most, events)
            kept, outside, wrong = found
            if wrong >= 0:
                self._refuse(raw, wrong)
            self._count, self._outside = self._count + len(t), self._outside + outside
            yield events[:kept]

    def _refuse(self, raw: RawEvents, place: int) -> None:
        check_times(raw.t[place : place + 1], self._recording.survey.unit, self._path)
        x, y, p = (part[place] for part in raw[1:])
        if p not in (-1, 0, 1):
            raise ValueError(f"{self._path}: polarity must be in -1, 0, 1, got {p}")
        raise ValueError(f"{self._path}: x and y must be in 0..{MAX_SIDE - 1}, got {x}, {y}")

    def _check(self, least: int = 0) -> None:
        fault = self._order.reason_to_refuse() if self._order.count > least else None
        if fault:
            raise ValueError(f"{self._path}: {fault}")

    def _tell_at_end(self) -> None:
        size = self._recording.size
        if not self._recording.survey.covers_all_times:
            self._order.check_part(self._part, self._path)
        if self._outside and size is not None:
            width, height = size
            if self._outside == self._count:
                x, y = self._most + 1
                raise ValueError(
                    f"{self._path}: all {self._count} events are off the {width}x{height} sensor, "
                    f"they need {x}x{y}; is sensor_size=[height,width] right?"
                )
            outside = f"{self._outside} of {self._count} events outside {width}x{height}, dropped"
            _tell((f"{self._path}: {outside}",))
        if not self._recording.survey.covers_all_times:
            _tell(self._order.describe_time_faults(self._path, part=self._recording.options.part))


def _plain(raw: RawEvents) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x, y as uint16 or int64 and p as int8, contiguous: few kinds to compile for."""
    x, y, p = raw.x, raw.y, raw.p
    kind = np.uint16 if x.dtype == y.dtype == np.uint16 else np.int64
    if p.dtype == np.bool_:
        p = p.view(np.int8)
    elif p.dtype != np.int8:
        p = np.clip(p, 0 if p.dtype.kind == "u" else -2, 2).astype(np.int8)
    x, y = (np.ascontiguousarray(side, kind) for side in (x, y))
    return x, y, np.ascontiguousarray(p)


def find_folder_reader(path: Path) -> Reader | None:
    """Return the reader of a folder that is a recording; None for a file and any other folder."""
    if not path.is_dir():
        return None
    kinds = {RosbagFile: is_bag_folder, EvrealFolder: is_evreal_folder, NpzFolder: find_npz_folder}
    return next((reader for reader, is_one in kinds.items() if is_one(path)), None)


def _open_file(path: Path, options: ReadOptions) -> EventFile:
    ending = "".join(path.suffixes[-2:]).lower()
    reader = READERS.get(ending) or READERS.get(path.suffix.lower())
    reader = find_folder_reader(path) or reader
    if reader is None:
        raise ValueError(f"{path}: unknown kind of event file, known are {', '.join(READERS)}")
    if reader in OF_ONE_CAMERA and options.stream not in (None, 0, "0"):
        raise ValueError(f"stream must be null, as {path} has one camera, got {options.stream}")
    file = reader(path, options)
    if file.time_unit is not None and options.time_unit not in ("auto", file.time_unit):
        raise ValueError(
            f"time_unit must be auto or {file.time_unit}, the unit of {path}, "
            f"got {options.time_unit}"
        )
    return file


@lru_cache(maxsize=1)
def _open_and_survey(
    path: Path, changed_ns: int, length: int, options: ReadOptions
) -> tuple[EventFile | None, TimeSurvey]:
    """Return what is opened, once for a file that does not change, and what its times tell; None
    for HDF5, of which an open file cannot be written."""
    file = _open_file(path, options)
    return (None if isinstance(file, Hdf5File) else file), survey_times(file, options)


def _tell(lines: Iterable[str]) -> None:
    for line in lines:
        warnings.warn(line, stacklevel=2)
