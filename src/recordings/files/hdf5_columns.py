"""Columns of events in groups and tables of HDF5, and those of windows one after the other."""

import re
from collections.abc import Sequence
from functools import partial
from typing import Any

import h5py
import numpy as np

from src.recordings.files.columns import check_lengths, extract_column, find_keys_by_name
from src.recordings.files.numpy_file import LazyColumn, split_table


def find_event_columns(node: Any, order: str | None) -> dict[str, Any]:
    """Return the columns t, x, y, p of a group or a table; `order`: columns=."""
    if not isinstance(node, h5py.Group):
        return split_table(node, order)
    keys = find_keys_by_name(node) or {}
    columns = {
        name: LazyColumn(node[key], partial(extract_column, name, key))
        for name, key in keys.items()
    }
    check_lengths(columns)
    return columns


def has_integer_times(t: Any) -> bool:
    """Return whether the first thousand times are whole numbers."""
    values = np.asarray(t[:1000])
    return np.array_equal(values, np.rint(values))


def find_numbered_streams(streams: dict[str, Any]) -> list[Any]:
    """Return the streams in order of their number where there are several, called alike but for a
    number at the end; else none."""
    found = {name: re.fullmatch(r"(.*?)(\d+)", name) for name in streams}
    numbers = {name: (match[1], int(match[2])) for name, match in found.items() if match}
    if len(streams) < 2 or len(numbers) < len(streams) or len({n for n, _ in numbers.values()}) > 1:
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
