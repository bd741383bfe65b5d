"""Columns of events in groups and tables of HDF5, and those of windows one after the other."""

import re
from typing import Any

import h5py
import numpy as np

from src.recordings.files.columns import check_lengths, find_keys_by_name
from src.recordings.files.numpy_file import split_table


def is_group(node: Any) -> bool:
    """Return whether a node is a group, no dataset."""
    return isinstance(node, h5py.Group)


def columns_of(node: Any, order: str | None) -> dict[str, Any]:
    """Return the columns t, x, y, p of a group or a table."""
    if not is_group(node):
        return split_table(node, order)
    columns = {name: node[key] for name, key in (find_keys_by_name(node) or {}).items()}
    check_lengths(columns)
    return columns


def starts_whole(t: Any) -> bool:
    """Return whether the first times are whole numbers."""
    values = np.asarray(t[:1000])
    return np.array_equal(values, np.rint(values))


def find_windows(streams: dict[str, Any]) -> list[Any]:
    """Return the streams in order of their number where all are parts of one recording: called
    alike but for a number at the end, each after the other in time; else none."""
    names = [re.fullmatch(r"(.*?)(\d+)", name) for name in streams]
    if len(names) < 2 or not all(names) or len({name[1] for name in names if name}) > 1:
        return []
    order = sorted(streams, key=lambda name: int(re.findall(r"\d+", name)[-1]))
    nodes = [streams[name] for name in order]
    ends = []
    for node in nodes:
        t = columns_of(node, None)["t"]
        if len(t):
            ends += [*np.asarray(t[:1]).tolist(), *np.asarray(t[len(t) - 1 :]).tolist()]
    return nodes if ends == sorted(ends) else []


class JoinedColumn:
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
