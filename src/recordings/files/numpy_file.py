"""Events in NumPy files: .npy and .npz, nothing of which is executed."""

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.files.column_names import (
    extract_column,
    find_keys_by_name,
    find_named_time_unit,
    find_time_column_names,
    require_one_time_column,
)
from src.recordings.files.column_values import DATES, check_lengths, check_unpacking_ratio
from src.recordings.files.event_file import (
    UNITS_US,
    EventFile,
    EventStream,
    RawEvents,
    ReadOptions,
    WidthHeight,
    choose_stream,
    name_file_in_errors,
    refuse_column_order,
    require_default_stream,
)
from src.recordings.files.lazy_columns import (
    flatten_column,
    has_event_per_column,
    slice_columns,
    slice_times,
    split_table,
)


class NumpyFile(EventFile):
    """A structured array, an array (n, 4), or an .npz with these or with columns of their own.

    An .npz may state `size` (width, height), or `width` and `height`, and `time_unit` (s, ms, us or
    ns).
    """

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with name_file_in_errors(path, "cannot be read as arrays of events"):
            if path.suffix.lower() == ".npy":
                table = np.load(path, mmap_mode="r")
                if not isinstance(table, np.ndarray):
                    raise ValueError("it is an .npz; name it so")
                self._columns = split_table(table, options.columns)
                self.time_unit = find_named_time_unit(table.dtype.names, options)
            else:
                with _open_npz(path) as file:
                    self.size = find_npz_size(file)
                    self._columns, names, self.notes = _columns_of(path, file, options)
                    self.time_unit = _find_stated_unit(file)
                    self.time_unit = self.time_unit or find_named_time_unit(names, options)
            check_lengths(self._columns)
            if np.asarray(self._columns["t"][:1]).dtype.kind in DATES:
                self.time_unit = "us"

    def pieces(self) -> Iterator[RawEvents]:
        yield from slice_columns(self.path, self._columns)

    def times(self) -> Iterator[np.ndarray]:
        yield from slice_times(self.path, self._columns["t"])


@contextmanager
def _open_npz(path: Path) -> Iterator[Any]:
    """Open an .npz that unpacks to what is believed of its size."""
    with zipfile.ZipFile(path) as archive:
        check_unpacking_ratio(path, sum(part.file_size for part in archive.infolist()))
    with np.load(path) as file:
        yield file


def read_nameless_table(path: Path, options: ReadOptions) -> np.ndarray | None:
    """Return the table (n, columns) of an .npz whose columns have no names; None for another."""
    with name_file_in_errors(path, "cannot be read as arrays of events"), _open_npz(path) as file:
        if find_keys_by_name(file.files) is not None:
            return None
        table, _ = _find_table(path, file, options)
        if table.dtype.names is not None:
            return None
        return table.T if has_event_per_column(table) else table


def find_npz_size(file: Any) -> WidthHeight | None:
    """Return what `size`, or `width` and `height`, of an .npz states; ValueError for other than two
    numbers."""
    if "size" not in file and not ("width" in file and "height" in file):
        return None
    names = ["size"] if "size" in file else ["width", "height"]
    sides = np.concatenate([file[name].ravel() for name in names]).tolist()
    if len(sides) != 2:
        raise ValueError(f"size must be (width, height), got {sides}")
    return int(sides[0]), int(sides[1])


def _find_stated_unit(file: Any) -> str | None:
    """Return what the string `time_unit` of an .npz states, None where it has none."""
    if "time_unit" not in file:
        return None
    unit = str(file["time_unit"])
    if unit not in UNITS_US:
        raise ValueError(f"time_unit in it must be {', '.join(UNITS_US)}, got {unit}")
    return unit


def _columns_of(
    path: Path, file: Any, options: ReadOptions
) -> tuple[dict[str, Any], Sequence[str] | None, tuple[str, ...]]:
    """Return the columns t, x, y, p of an .npz, the names they are found by (None: by values), and
    a note of other arrays of events in it."""
    keys = find_keys_by_name(file.files)
    if keys is not None:
        require_default_stream(path, options.stream)
        refuse_column_order(options.columns, "the arrays in it have names")
        columns = {
            name: flatten_column(extract_column(name, key, file[key])) for name, key in keys.items()
        }
        if any(column.ndim != 1 for column in columns.values()):
            raise ValueError("columns must have one dimension")
        others = [name for name in find_time_column_names(file.files) if name != keys["t"]]
        count = len(columns["t"])
        require_one_time_column([keys["t"], *(name for name in others if file[name].size == count)])
        return columns, file.files, ()
    table, notes = _find_table(path, file, options)
    return split_table(table, options.columns), table.dtype.names, notes


def _find_table(path: Path, file: Any, options: ReadOptions) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the array of events of an .npz, and a note of others in it."""
    for is_called_events in (True, False):
        names = [name for name in file.files if ("event" in name.lower()) == is_called_events]
        tables = {name: table for name in names if _is_table(table := file[name])}
        if tables:
            streams = [EventStream(place, name, None) for place, name in enumerate(tables)]
            chosen, notes = choose_stream(path, streams, options.stream)
            return tables[chosen.name], notes
    raise ValueError(f"no columns t, x, y, p and no array of events among {', '.join(file.files)}")


def _is_table(table: np.ndarray) -> bool:
    fields = table.dtype.names
    return bool(fields and find_keys_by_name(fields)) or (
        table.ndim == 2 and (table.shape[1] == 4 or has_event_per_column(table))
    )
