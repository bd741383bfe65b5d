"""Columns of tables, of which slices are read as they are wanted, and pieces of events of these."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.files.column_names import (
    extract_column,
    find_keys_by_name,
    find_time_column_names,
    require_one_time_column,
)
from src.recordings.files.column_values import as_integers, as_times, find_columns
from src.recordings.files.event_file import PIECE_EVENTS, RawEvents, name_file_in_errors

ENOUGH_EVENTS = 10_000  # of windows, that tell the order of columns or parts of pixels
LEAST_COLUMNS = 16  # of a table of four rows, from which these are the columns of events


class LazyColumn:
    """A column of `table`, of which slices are read and given to `pick_column`."""

    def __init__(self, table: Any, pick_column: Callable[[Any], Any]):
        self.table, self.pick_column = table, pick_column

    def __len__(self) -> int:
        return len(self.table)

    def __getitem__(self, part: slice) -> np.ndarray:
        return self.pick_column(self.table[part])


def split_table(table: Any, order: str | None) -> dict[str, Any]:
    """Return the columns t, x, y, p of a structured array or of one (n, columns), in any of which
    slices can be taken; `order`: columns=, before the names of fields.  Arrays may also be (4, n)
    and (n, 1), as MATLAB has them.  Raises ValueError for another array."""
    names = table.dtype.names
    if isinstance(table, np.ndarray):
        if names is not None:
            table = flatten_column(table)
        elif has_event_per_column(table):
            table = table.T
    if names is not None:
        keys = find_keys_by_name(names) if order is None else _name_fields(names, order)
        if order is None:
            require_one_time_column(find_time_column_names(names), of_a_table=True)
        if keys is None or table.ndim != 1:
            raise ValueError(f"fields must be t, x, y, p of one dimension, got {', '.join(names)}")
        return {
            name: LazyColumn(table, partial(_extract_field, name, key))
            for name, key in keys.items()
        }
    if table.ndim != 2 or table.shape[1] < 4:
        raise ValueError(f"an array must be (n, 4) or have fields t, x, y, p, got {table.shape}")
    sample = np.asarray(table[:PIECE_EVENTS])
    if sample.dtype.kind not in "iufb":
        raise ValueError(f"an array must hold numbers, got {sample.dtype}")
    if not len(sample):
        return dict.fromkeys("txyp", np.empty(0))
    places = find_columns(sample.astype(np.float64), order)
    return {
        name: LazyColumn(table, itemgetter((slice(None), place))) for name, place in places.items()
    }


def _name_fields(names: Sequence[str], order: str) -> dict[str, str]:
    """Return the names of the fields t, x, y, p that stand in `order`."""
    places = find_columns(np.empty((0, len(names))), order)
    return {letter: names[place] for letter, place in places.items()}


def _extract_field(letter: str, key: str, rows: np.ndarray) -> np.ndarray:
    return extract_column(letter, key, rows[key])


def has_event_per_column(table: Any) -> bool:
    """Return whether an array has an event in each column: (4, n), not (n, 4)."""
    return table.ndim == 2 and table.shape[0] == 4 and table.shape[1] >= LEAST_COLUMNS


def flatten_column(column: np.ndarray) -> np.ndarray:
    """Return (n, 1) or (1, n), as MATLAB has columns, as (n,); others as they are."""
    return column.ravel() if column.ndim == 2 and 1 in column.shape else column


def slice_times(path: Path, t: Any) -> Iterator[np.ndarray]:
    """Yield the times of the pieces of `slice_columns`."""
    with name_file_in_errors(path, "times cannot be read"):
        for first in range(0, len(t), PIECE_EVENTS):
            yield as_times(np.asarray(t[first : first + PIECE_EVENTS]))


def slice_columns(
    path: Path, columns: dict[str, Any], times: list[np.ndarray] | None = None
) -> Iterator[RawEvents]:
    """Yield pieces of columns; `times`: those of the pieces, if they were read before."""
    for number, first in enumerate(range(0, len(columns["t"]), PIECE_EVENTS)):
        part = slice(first, first + PIECE_EVENTS)
        with name_file_in_errors(path, f"events from {first} on cannot be read"):
            t = times[number] if times is not None else as_times(np.asarray(columns["t"][part]))
            x, y, p = (as_integers(name, np.asarray(columns[name][part])) for name in "xyp")
        yield RawEvents(t, x, y, p)


def find_order_of_windows(tables: Iterable[Any]) -> str | None:
    """Return the order (columns=) that the first events of windows, tables (n, columns) without
    names, tell together; None where they do not, or one of them is None."""
    samples: list[np.ndarray] = []
    for table in tables:
        if table is None:
            return None
        samples.append(np.asarray(table[:PIECE_EVENTS]))
        if sum(map(len, samples)) >= ENOUGH_EVENTS:
            break
    try:
        places = find_columns(np.concatenate(samples).astype(np.float64), None)
    except (ValueError, TypeError):  # said of the window that is read first
        return None
    letters = {place: letter for letter, place in places.items()}
    return "".join(letters.get(place, "_") for place in range(max(letters) + 1))
