"""Event files of any format as one structured array: t int64 us, x, y uint16, p int8.

What is wrong with a file is an error that names it, or a warning with the number of events
concerned.
"""

import os
import stat
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.engines.event_passes import MAX_COORDINATE, copy_events_on_sensor
from src.recordings.files.aedat1to3_file import Aedat1To3File
from src.recordings.files.aedat4_file import Aedat4File
from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.es_file import EsFile
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.files.event_file import (
    EVENT,
    EventFile,
    RawEvents,
    ReadOptions,
    WidthHeight,
    refuse_column_order,
    require_default_stream,
)
from src.recordings.files.event_order import EventSorter, merge_in_time
from src.recordings.files.evreal_folder import EvrealFolder, is_evreal_folder
from src.recordings.files.frame_files import PICTURE_FOLDERS
from src.recordings.files.hdf5_file import HDF5_ENDINGS, Hdf5File
from src.recordings.files.npz_folder import EVENT_FOLDERS, NpzFolder, find_npz_folder
from src.recordings.files.numpy_file import NumpyFile
from src.recordings.files.prophesee_file import PropheseeFile
from src.recordings.files.rosbag_file import RosbagFile, is_bag_folder
from src.recordings.files.sensor_size import (
    MOST_OUTSIDE,
    check_sensor_size,
    choose_size,
    describe_oversized_coordinates,
    find_swapped_size,
    report_events_outside,
)
from src.recordings.files.survey import TimeSurvey, survey_times
from src.recordings.files.text_file import TextFile
from src.recordings.files.text_layout import TEXT_ENDINGS
from src.recordings.files.time_unit import check_times, to_us
from src.sim.user_values import read_path

Reader = Callable[[Path, ReadOptions], EventFile]
FileState = tuple[str, int, int]
READERS: dict[str, Reader] = {  # by the ending, in small letters
    ".raw": PropheseeFile, ".dat": PropheseeFile, ".aedat4": Aedat4File, ".aedat": Aedat1To3File,
    ".aedat2": Aedat1To3File, ".es": EsFile, ".bag": RosbagFile, ".db3": RosbagFile,
    ".mcap": RosbagFile, ".npy": NumpyFile, ".npz": NumpyFile,
    **dict.fromkeys(HDF5_ENDINGS, Hdf5File),
    **dict.fromkeys((*TEXT_ENDINGS, ".gz", ".zip"), TextFile),
}  # fmt: skip
OF_ONE_CAMERA = (PropheseeFile, EsFile, TextFile, EvrealFolder)
NO_TABLES = (PropheseeFile, Aedat4File, Aedat1To3File, EsFile, RosbagFile, EvrealFolder)
OF_THE_CAMERA = (PropheseeFile, EsFile, Aedat4File, Aedat1To3File)  # it wrote the sensor's size


@dataclass(frozen=True)
class EventRecording:
    """An event file: `size` is its (width, height) in pixels, None where neither the file nor the
    user says; `size_messages`: lines for the user where they differ."""

    path: Path
    size: WidthHeight | None
    options: ReadOptions
    file: EventFile
    survey: TimeSurvey
    size_messages: tuple[str, ...] = ()

    @property
    def messages(self) -> tuple[str, ...]:
        """Return what the user is told before the file is read."""
        return *self.file.notes, *self.survey.messages, *self.size_messages

    def check_sensor_size(self) -> None:
        """Raise ValueError where half of the first events or more are off the sensor."""
        first = next(iter(self.survey.pieces or self.file.pieces()), None)
        if self.size is None or first is None or not len(first.t):
            return
        (width, height), largest = self.size, np.array([first.x.max(), first.y.max()], int)
        outside = int(np.sum((first.x >= width) | (first.y >= height)))
        if outside >= MOST_OUTSIDE * len(first.t):
            report_events_outside(self.path, self.size, len(first.t), outside, largest)

    def __iter__(self) -> Iterator[np.ndarray]:
        """Yield the events in pieces, not empty, in order of time; warn of what was wrong."""
        if self.survey.parts_are_on_and_off:
            yield from merge_in_time(_read_part(self, 0), _read_part(self, 1))
        else:
            yield from _read_part(self, self.options.part or 0)


def open_recording(
    path: str | Path, sensor_size: Sequence[int] | None = None, options: ReadOptions = ReadOptions()
) -> EventRecording:
    """Return the recording at `path`; `sensor_size` comes before what the file states.

    Of a table all times are read here, and what is odd about their unit or order is a warning, as
    is a size that the file states and its events or `sensor_size` contradict.
    Raises ValueError for a file that is missing, empty, of an unknown kind or cannot be read.
    """
    if not isinstance(options, ReadOptions):
        raise ValueError(f"options must be ReadOptions(...), got {options}")
    path = read_path("recording", path)
    if find_folder_reader(path) is None and (not path.is_file() or path.stat().st_size == 0):
        raise ValueError(f"recording must be an event file, got {path}: {_why_not_a_file(path)}")
    kept, survey, swapped = _open_and_survey(path, find_file_states(path), options)
    file = _open_file(path, options) if kept is None else copy(kept)
    file.kept_times = survey.times
    given = None if sensor_size is None else check_sensor_size(sensor_size)
    file.use_sensor_size(given)
    size, lines = choose_size(path, given, file.size, swapped)
    recording = EventRecording(path, size, options, file, survey, lines)
    _tell(recording.messages)
    return recording


def read_events(
    path: str | Path, *, sensor_size: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(), size: Any = None,
) -> np.ndarray:  # fmt: skip
    """Return all events of a file, (n,) of t int64 us, x, y uint16, p int8 in {-1, 1}, in order of
    time.

    `sensor_size`: (height, width) in pixels, where the file does not state it or states another;
    where neither says, no event is off the sensor.  `options`: what the file does not say
    (ReadOptions).  Raises ValueError for a file that cannot be read, and for the former `size`;
    warns of what was sorted or dropped, with the number of events.
    """
    if size is not None:
        raise ValueError(f"size=(width, height) is now sensor_size=(height, width), got {size}")
    pieces = list(open_recording(path, sensor_size, options))
    return concatenate_events(pieces) if pieces else np.empty(0, EVENT)


def iter_events(
    path: str | Path,
    *,
    seconds: float = 0.1,
    sensor_size: Sequence[int] | None = None,
    options: ReadOptions = ReadOptions(),
) -> Iterator[np.ndarray]:
    """Yield the events of a file in chunks of `seconds` from the first event, those without events
    left out, in the memory of one chunk.  Raises as `read_events` does."""
    if not 1e-6 <= seconds <= 1e6:
        raise ValueError(f"seconds must be in [1e-6, 1e6], got {seconds}")
    yield from cut_chunks(open_recording(path, sensor_size, options), seconds)


def cut_chunks(pieces: Iterable[np.ndarray], seconds: float) -> Iterator[np.ndarray]:
    """Yield the events of `pieces`, in order of time, as `iter_events` does those of a file."""
    span, start, held = round(seconds * 1e6), None, []
    for events in pieces:
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


def _read_part(recording: EventRecording, part: int) -> Iterator[np.ndarray]:
    """Yield the events of one part on the sensor, in order; warn at the end of what was wrong."""
    path, survey, size = recording.path, recording.survey, recording.size
    order = EventSorter(survey.buffer_us, survey.min_part_events, part)
    count, outside, largest_xy = 0, 0, np.zeros(2, np.int64)
    clock = TimestampUnwrapper(survey.wrap_bits) if survey.wrap_bits else None
    for raw in survey.pieces or recording.file.pieces():
        raw = raw if clock is None else raw._replace(t=clock.unwrap(raw.t))
        events, off_sensor = _convert(raw, recording, largest_xy)
        count, outside = count + len(raw.t), outside + off_sensor
        is_ordered = survey.is_ordered and part == 0
        yield from filter(len, [events] if is_ordered else order.add(events))
        if order.count > 2**20:
            _refuse_disorder(order, path)
    yield from filter(len, order.finish())
    _refuse_disorder(order, path)
    if not survey.covers_all_times:
        order.check_part(part, path)
    if size is not None:
        report_events_outside(path, size, count, outside, largest_xy)
    if not survey.covers_all_times:
        _tell(order.describe_time_faults(path, part=recording.options.part))


def _convert(
    raw: RawEvents, recording: EventRecording, largest_xy: np.ndarray
) -> tuple[np.ndarray, int]:
    """Return the events of a piece on the sensor, as the file has them, and how many are off it."""
    path, unit = recording.path, recording.survey.unit
    if not recording.survey.covers_all_times and (raw.t.dtype != np.int64 or unit != "us"):
        check_times(raw.t, unit, path)
    events, (width, height) = np.empty(len(raw.t), EVENT), recording.size or (0, 0)
    columns = to_us(raw.t, unit), *_plain(raw)
    kept, outside, wrong = copy_events_on_sensor(*columns, width, height, largest_xy, events)
    if wrong >= 0:
        check_times(raw.t[wrong : wrong + 1], unit, path)
        x, y, p = (part[wrong] for part in raw[1:])
        if p not in (-1, 0, 1):
            raise ValueError(f"{path}: polarity must be in -1, 0, 1, got {p}")
        raise ValueError(f"{path}: x and y must be in 0..{MAX_COORDINATE}, got {x}, {y}")
    p = columns[-1]
    if p.size and p.min() < 0 and not p.all():
        raise ValueError(f"{path}: polarity must be 0 and 1 or -1 and 1, got -1 and 0")
    return events[:kept], outside


def _refuse_disorder(order: EventSorter, path: Path) -> None:
    if fault := order.reason_to_refuse():
        raise ValueError(f"{path}: {fault}")


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


def _why_not_a_file(path: Path) -> str:
    if path.is_dir():
        return "a folder"
    if path.exists():
        return "the file is empty" if path.is_file() else "can be read only once; save it as a file"
    return "no such file"


def find_folder_reader(path: Path) -> Reader | None:
    """Return the reader of a folder that is a recording; None for a file and any other folder."""
    if not path.is_dir():
        return None
    kinds = {RosbagFile: is_bag_folder, EvrealFolder: is_evreal_folder, NpzFolder: find_npz_folder}
    return next((reader for reader, is_one in kinds.items() if is_one(path)), None)


def find_file_states(path: Path) -> tuple[FileState, ...]:
    """Return path, time of change in ns and bytes of a file, or of those that a folder is read
    from: in it, in its folders of events and pictures, and of pictures beside it."""
    files: Iterable[Path | os.DirEntry] = (path,)
    if path.is_dir():
        events = (path / name for name in EVENT_FOLDERS)
        pictures = (place / name for place in (path, path.parent) for name in PICTURE_FOLDERS)
        folders = dict.fromkeys(filter(Path.is_dir, (*events, *pictures)))
        files = (file for folder in folders for file in os.scandir(folder))
    return tuple(sorted(filter(None, map(_find_file_state, files))))


def _find_file_state(file: Path | os.DirEntry) -> FileState | None:
    """Return None for what is no file, or none any more."""
    try:
        state = file.stat()
    except OSError:
        return None
    is_file = stat.S_ISREG(state.st_mode)
    return (os.fspath(file), state.st_mtime_ns, state.st_size) if is_file else None


def _open_file(path: Path, options: ReadOptions) -> EventFile:
    ending = "".join(path.suffixes[-2:]).lower()
    reader = READERS.get(ending) or READERS.get(path.suffix.lower())
    reader = find_folder_reader(path) or reader
    if reader is None:
        raise ValueError(f"{path}: unknown kind of event file, known are {', '.join(READERS)}")
    if reader in OF_ONE_CAMERA:
        require_default_stream(path, options.stream)
    if reader in NO_TABLES:
        refuse_column_order(options.columns, f"{path} is no table")
    if options.format is not None and path.suffix.lower() != ".raw":
        raise ValueError(f"format must be null, as {path} is no RAW file, got {options.format}")
    inner = Path(path.stem).suffix.lower()
    is_other = inner == ".tar" or READERS.get(inner, TextFile) is not TextFile
    if path.suffix.lower() == ".gz" and is_other:
        raise ValueError(f"{path}: only text is read from a .gz; unpack {path.stem} first")
    file = reader(path, options)
    if file.time_unit is not None and options.time_unit not in ("auto", file.time_unit):
        raise ValueError(
            f"time_unit must be auto or {file.time_unit}, the unit of {path}, "
            f"got {options.time_unit}"
        )
    return file


@lru_cache(maxsize=1)
def _open_and_survey(
    path: Path, states: tuple[FileState, ...], options: ReadOptions
) -> tuple[EventFile | None, TimeSurvey, WidthHeight | None]:
    """Return what is opened, once for files that do not change, what its times tell, and the
    size that its events show where it is stated the wrong way round (find_swapped_size).

    Instead of an HDF5 file None: an open one cannot be written.
    """
    file = _open_file(path, options)
    survey, swapped = survey_times(file, options), None
    if not isinstance(file, OF_THE_CAMERA):
        swapped = find_swapped_size(file, survey.pieces or file.pieces())
        lines = describe_oversized_coordinates(file, survey.pieces or file.pieces())
        survey = survey._replace(messages=survey.messages + lines)
    return (None if isinstance(file, Hdf5File) else file), survey, swapped


def _tell(lines: Iterable[str]) -> None:
    for line in lines:
        warnings.warn(line, stacklevel=2)
