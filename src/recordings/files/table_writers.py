"""Events to tables: CSV, npz, HDF5 in DSEC's layout, and EVREAL's folder of .npy; in pieces.

Polarity is written as 0 and 1, time in microseconds but where a layout has another unit.
"""

import json
import tempfile
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from itertools import chain, islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.lib.format import open_memmap

from src.recordings.files.event_file import WidthHeight
from src.recordings.files.recorded_frames import RecordedFrames
from src.records.atomic import check_free_space

EVREAL_TIMES = "events_ts.npy"
EVREAL_FILES = {
    EVREAL_TIMES, "events_xy.npy", "events_p.npy", "metadata.json", "images.npy", "images_ts.npy",
    "image_event_indices.npy",
}  # fmt: skip
CHUNK_EVENTS = 2**16  # in HDF5
Pieces = Iterator[np.ndarray]


def write_csv(path: Path, pieces: Pieces, size: WidthHeight) -> None:
    """Write `t,x,y,p` a line, behind a first line that names them, the unit of t and the sensor's
    sides."""
    with path.open("w") as file:
        file.write(f"t_us,x@{size[0]},y@{size[1]},p\n")
        for events in pieces:
            columns = (events["t"], events["x"], events["y"], events["p"] > 0)
            rows = zip(*(column.astype(np.int64).tolist() for column in columns), strict=True)
            file.writelines(f"{t},{x},{y},{p}\n" for t, x, y, p in rows)


def write_npz(path: Path, pieces: Pieces, size: WidthHeight) -> None:
    """Write the arrays t int64, x, y uint16, p uint8, size (width, height) and time_unit, "us"."""
    kinds = {"t": np.int64, "x": np.uint16, "y": np.uint16, "p": np.uint8}
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=".partial") as folder:
        columns = {name: Path(folder) / f"{name}.npy" for name in kinds}
        _write_columns(
            [(columns[name], kind, ()) for name, kind in kinds.items()],
            ((part["t"], part["x"], part["y"], part["p"] > 0) for part in pieces),
        )
        np.save(Path(folder) / "size.npy", np.array(size))
        np.save(Path(folder) / "time_unit.npy", np.array("us"))
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            for column in sorted(Path(folder).iterdir()):
                archive.write(column, column.name)


def write_evreal(
    path: Path, pieces: Pieces, size: WidthHeight, frames: RecordedFrames | None = None
) -> None:
    """Write a folder as EVREAL reads one (evreal_folder.py), with the frames up to the first at or
    after the last event; the clock starts at 0 with the first event or frame."""
    path.mkdir()
    files = [
        (path / EVREAL_TIMES, np.float64, ()),
        (path / "events_xy.npy", np.int16, (2,)),
        (path / "events_p.npy", np.uint8, ()),
    ]
    first = list(islice(pieces, 1))
    starts = [part["t"][0] for part in first] + ([] if frames is None else [frames.times_us[0]])
    zero_us = float(min(starts, default=0))
    columns = (
        ((part["t"] - zero_us) * 1e-6, np.stack([part["x"], part["y"]], 1), part["p"] > 0)
        for part in chain(first, pieces)
    )
    _write_columns(files, columns)
    (path / "metadata.json").write_text(json.dumps({"sensor_resolution": [size[1], size[0]]}))
    if frames is not None and first:
        _write_evreal_frames(path, frames, zero_us)


def _write_evreal_frames(path: Path, frames: RecordedFrames, zero_us: float) -> None:
    t = np.load(path / EVREAL_TIMES, mmap_mode="r")
    times = (frames.times_us - zero_us) * 1e-6
    kept = np.arange(len(times)) <= np.searchsorted(times, t[-1])
    if (dropped := int((~kept).sum())) > 0:
        warnings.warn(
            f"{dropped} of {len(times)} frames come after the last event, left out", stacklevel=2
        )
    times = times[kept][:, None]
    stored = open_memmap(path / "images.npy", "w+", np.uint8, (len(times), *frames.size, 1))
    for place, picture in enumerate(frames.select(kept).pictures()):
        stored[place, ..., 0] = picture
    stored.flush()
    np.save(path / "images_ts.npy", times)
    index = np.searchsorted(t, times, "right") - 1  # of the last event at or before a frame
    np.save(path / "image_event_indices.npy", index.clip(0, len(t) - 1))


def write_dsec(path: Path, pieces: Pieces, size: WidthHeight) -> None:
    """Write HDF5 as DSEC (Gehrig et al. 2021) has it: events/x, y, p, t (microseconds after
    t_offset), ms_to_idx (the first event at or after each millisecond), and the sensor's (height,
    width) as the attribute sensor_resolution."""
    kinds = {"t": np.uint32, "x": np.uint16, "y": np.uint16, "p": np.uint8}
    with h5py.File(path, "w") as file:
        file.attrs["sensor_resolution"] = (size[1], size[0])
        columns = {name: _growing(file, f"events/{name}", kind) for name, kind in kinds.items()}
        marks = _growing(file, "ms_to_idx", np.uint64)
        count, offset = 0, 0
        for events in pieces:
            check_free_space(path.parent)
            offset = offset if count else int(events["t"][0])
            t = events["t"] - offset
            due = np.arange(len(marks), t[-1] // 1000 + 1) * 1000
            _append(marks, np.searchsorted(t, due) + count)
            for name, part in zip(
                "txyp", (t, events["x"], events["y"], events["p"] > 0), strict=True
            ):
                _append(columns[name], part)
            count += len(events)
        _append(marks, np.array([count]))  # after the last event
        file["t_offset"] = np.int64(offset)


def _growing(file: h5py.File, name: str, kind: type) -> h5py.Dataset:
    how = {"maxshape": (None,), "chunks": (CHUNK_EVENTS,), "compression": 1, "shuffle": True}
    return file.create_dataset(name, (0,), kind, **how)


def _append(column: h5py.Dataset, values: np.ndarray) -> None:
    count = len(column)
    column.resize(count + len(values), axis=0)
    column[count:] = values


def _write_columns(
    files: Sequence[tuple[Path, type, tuple[int, ...]]], pieces: Iterator[tuple[np.ndarray, ...]]
) -> None:
    """Write .npy files, (path, type, shape of a row) each, from rows that come in pieces."""
    with ExitStack() as stack:
        opened = [(stack.enter_context(path.open("wb")), kind, row) for path, kind, row in files]
        _write_heads(opened, 0)
        count = 0
        for rows in pieces:
            count += len(rows[0])
            for (file, kind, _), part in zip(opened, rows, strict=True):
                file.write(part.astype(kind).tobytes())
        _write_heads(opened, count)  # as long as before, numpy leaves room for the count


def _write_heads(opened: list[tuple[Any, type, tuple[int, ...]]], count: int) -> None:
    for file, kind, row in opened:
        file.seek(0)
        head = {"descr": np.dtype(kind).str, "fortran_order": False, "shape": (count, *row)}
        np.lib.format.write_array_header_1_0(file, head)
