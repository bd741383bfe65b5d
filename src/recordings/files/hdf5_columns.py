"""Columns of events in groups and tables of HDF5, and those of windows one after the other."""

import re
from collections.abc import Sequence
from typing import Any

import h5py
import numpy as np

from src.recordings.files.column_names import (
    JOINT,
    extract_column,
    find_keys_by_name,
    find_time_column_names,
    find_time_unit_in_text,
    require_one_time_column,
)
from src.recordings.files.column_values import as_times, check_lengths
from src.recordings.files.event_file import UNITS_US, ReadOptions, refuse_column_order
from src.recordings.files.lazy_columns import LazyColumn, has_event_per_column, split_table

# Before a number: cam0, leftcam0, cameras/0, view_0, but not review0.
OF_A_CAMERA = re.compile(r"(?:cam|camera|(?<![a-z])view|(?<![a-z])sensor)s?[\W_]*$")


def find_event_columns(node: Any, order: str | None) -> dict[str, Any]:
    """Return the columns t, x, y, p of a group or a table, times after the `t_offset` beside them
    or of the file; `order`: columns=."""
    if isinstance(node, h5py.Group):
        refuse_column_order(order, "the arrays in it have names")
        keys = find_keys_by_name(node) or {}
        columns = {name: _open_column(node[key], name, key) for name, key in keys.items()}
        check_lengths(columns)
        shape = node[keys["t"]].shape
        times = [
            name
            for name in find_time_column_names(node)
            if getattr(node[name], "shape", 0) == shape
        ]
        require_one_time_column(times)
    else:
        columns = split_table(_upright(node), order)
    start = _find_offset(node)
    if start is not None:
        columns["t"] = LazyColumn(columns["t"], lambda t: as_times(np.asarray(t)) + start)
    return columns


def find_nameless_table(node: Any) -> Any:
    """Return a table without names as (n, columns), of which slices are read; None for others."""
    is_table = isinstance(node, h5py.Dataset) and node.dtype.names is None
    return _upright(node) if is_table else None


def _upright(table: Any) -> Any:
    return _Turned(table) if has_event_per_column(table) else table


def has_column_shape(key: str, node: Any, is_matlab: bool) -> bool:
    """Return whether `node` has the shape of a column of that name: (n,) or, if `is_matlab`, (n, 1)
    or (1, n); (n, 2) for JOINT, of which another width is an error that is told later."""
    if not isinstance(node, h5py.Dataset):
        return False
    if key == JOINT:
        return node.ndim == 2
    return node.ndim == 1 or (is_matlab and node.ndim == 2 and 1 in node.shape)


def list_event_array_shapes(file: h5py.File) -> str:
    """Return the shapes of the first three arrays that are called events, "" for none."""
    found: list[str] = []

    def visit(name: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset) and "event" in name.lower():
            found.append(f"{name} {node.shape}")

    file.visititems(visit)
    return ", ".join(found[:3])


def read_units_attribute(node: Any, options: ReadOptions) -> str | None:
    """Return the unit that the attribute `units` or `unit` of the times of a group states, where
    `options` do not, or None."""
    keys = find_keys_by_name(node) if isinstance(node, h5py.Group) else None
    if keys is None or options.time_unit != "auto":
        return None
    attributes = node[keys["t"]].attrs
    stated = next((attributes[name] for name in ("units", "unit") if name in attributes), None)
    if not isinstance(stated, str | bytes | np.ndarray):
        return None
    words = np.ravel(np.asarray(stated)).astype(str)
    return find_time_unit_in_text(words[0]) if len(words) else None


def find_time_unit_by_ms_to_idx(marks: h5py.Dataset, t: Any) -> str | None:
    """Return the unit of times (n,) whose first event of each millisecond is at `marks` (DSEC's
    ms_to_idx): the nearest, within a factor of three; else us of whole numbers, None of others."""
    usual = "us" if are_times_whole(t) else None
    if marks.ndim != 1 or marks.dtype.kind not in "iu":
        return None
    index = marks[:].astype(np.int64)
    inside = np.flatnonzero((index > 0) & (index < len(t)))
    if len(inside) < 2:
        return usual
    first, last = (int(inside[k]) for k in (0, -1))
    start, end = (float(np.asarray(t[index[k] : index[k] + 1])[0]) for k in (first, last))
    if not end > start:
        return usual
    off = {
        unit: abs(np.log10((end - start) * unit_us / (1000 * (last - first))))
        for unit, unit_us in UNITS_US.items()
    }
    unit = min(off, key=off.__getitem__)
    return unit if off[unit] < 0.5 else usual


def are_times_whole(t: Any) -> bool:
    """Return whether the first thousand times are whole numbers."""
    values = np.asarray(t[:1000])
    return np.array_equal(values, np.rint(values))


def find_numbered_streams(streams: dict[str, Any]) -> list[Any]:
    """Return the streams in order of their number where there are several, called alike but for a
    number at the end, which is not that of a camera or a view; else none."""
    found = {name: re.fullmatch(r"(.*?)(\d+)", name) for name in streams}
    numbers = {name: (match[1], int(match[2])) for name, match in found.items() if match}
    stems = {stem for stem, _ in numbers.values()}
    if len(streams) < 2 or len(numbers) < len(streams) or len(stems) > 1:
        return []
    if OF_A_CAMERA.search(stems.pop().lower()):
        return []
    return [streams[name] for name in sorted(streams, key=numbers.__getitem__)]


def are_consecutive_in_time(columns: Sequence[dict[str, Any]]) -> bool:
    """Return whether each of the streams with these columns begins after the one before ends."""
    ends = []
    for t in (one["t"] for one in columns if len(one["t"])):
        ends += [*np.asarray(t[:1]).tolist(), *np.asarray(t[len(t) - 1 :]).tolist()]
    return ends == sorted(ends)


class ConcatenatedColumn:
    """Columns one after the other, of which slices can be taken."""

    def __init__(self, parts: list[Any]):
        self.parts = [part for part in parts if len(part)]
        self.starts = np.cumsum([0, *map(len, self.parts)])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def __getitem__(self, part: slice) -> np.ndarray:
        first, last, _ = part.indices(len(self))
        pieces = [
            np.asarray(column[max(first - start, 0) : last - start])
            for column, start in zip(self.parts, self.starts.tolist(), strict=False)
            if start < last and start + len(column) > first
        ]
        return np.concatenate(pieces) if pieces else np.empty(0, np.int64)


class _Turned:
    """An array (columns, n) of a file as (n, columns), of which slices of rows are read."""

    def __init__(self, table: Any):
        self._table, self.dtype = table, table.dtype
        self.shape, self.ndim = table.shape[::-1], table.ndim

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, rows: slice) -> np.ndarray:
        return self._table[:, rows].T


def _open_column(node: Any, name: str, key: str) -> LazyColumn:
    is_row = node.ndim == 2 and node.shape[0] == 1 and key != JOINT
    return LazyColumn(
        _Turned(node) if is_row else node, lambda rows: extract_column(name, key, rows).reshape(-1)
    )


def _find_offset(node: Any) -> float | None:
    """Return the `t_offset` beside the columns of a group or a table, else that of the file."""
    beside = node if isinstance(node, h5py.Group) else node.parent
    for place in (beside, node.file):
        offset = place.get("t_offset")
        if not isinstance(offset, h5py.Dataset) or offset.dtype.kind not in "iuf":
            continue
        if offset.size != 1:
            raise ValueError(f"t_offset must be one number, got {offset.shape}")
        start = np.asarray(offset).item()
        if not np.isfinite(start):
            raise ValueError(f"t_offset must be finite, got {start}")
        return int(start) if start == int(start) else start
    return None
