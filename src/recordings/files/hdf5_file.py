"""Events in HDF5: columns in any group, arrays (n, 4) and structured ones, packed by Blosc, LZ4,
Zstd, bitshuffle or gzip.

Known layouts: DSEC (events/{x, y, t, p} in us after `t_offset`; Gehrig et al. 2021), v2e and MVSEC
(`events`, n x 4), event_cnn_minimal (xs, ys, ts, ps) and any other group with such columns.
"""

import math
import re
from collections.abc import Iterable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # noqa: F401 - its codecs are registered by the import
import numpy as np

from src.recordings.files.column_names import find_keys_by_name, find_named_time_unit
from src.recordings.files.column_values import check_unpacking_ratio
from src.recordings.files.event_file import (
    EventFile,
    EventStream,
    RawEvents,
    RawFrames,
    ReadOptions,
    WidthHeight,
    choose_stream,
    name_file_in_errors,
)
from src.recordings.files.frame_files import to_gray, wrap_frame_array
from src.recordings.files.hdf5_columns import (
    ConcatenatedColumn,
    are_consecutive_in_time,
    find_event_columns,
    find_nameless_table,
    find_numbered_streams,
    find_time_unit_by_ms_to_idx,
    has_column_shape,
    list_event_array_shapes,
    read_units_attribute,
)
from src.recordings.files.lazy_columns import (
    find_order_of_windows,
    has_event_per_column,
    slice_columns,
    slice_times,
)

HDF5_ENDINGS = (".h5", ".hdf5", ".hdf")
SIZE_NAMES = ("size", "geometry", "sensor_size")  # width, height
SHAPE_NAMES = ("sensor_resolution", "resolution")  # height, width; of the latter also the reverse
DEFAULT_CACHE_BYTES = 2**20  # of unpacked chunks for each dataset; one larger chunk
MAX_CHUNK_BYTES = 2**28  # bytes of HDF5 that are unpacked at a time
ECF_CODEC = 36559  # the number of Prophesee's codec


class Hdf5File(EventFile):
    """An HDF5 file with one stream of events, or several, of which one is read; numbered ones that
    follow in time are one, unless they state different sizes or are called cameras or views."""

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with name_file_in_errors(path, "cannot be read as events"):
            with h5py.File(path) as file:
                largest = check_hdf5_safety(file)
            self._file = h5py.File(path, rdcc_nbytes=max(largest, DEFAULT_CACHE_BYTES))
            streams = find_streams(self._file)
            if not streams:
                found = list_event_array_shapes(self._file)
                raise ValueError(
                    "no columns t, x, y, p and no array of events (n, 4) in it"
                    + (f", but {found}" if found else "")
                )
            nodes = find_numbered_streams(streams) if options.stream is None else []
            sizes = {stated[0] for stated in map(_stated_size, nodes) if stated}
            nodes = [] if len(sizes) > 1 else nodes
            columns = self._find_columns(nodes, options)
            if nodes and are_consecutive_in_time(columns):
                line = f"{len(nodes)} event streams, one after the other, are read as one"
                self.notes = (f"{path}: {line} (stream= chooses one)",)
            else:
                listed = [EventStream(k, name, None) for k, name in enumerate(streams)]
                chosen, self.notes = choose_stream(path, listed, options.stream)
                nodes = [streams[chosen.name]]
                columns = self._find_columns(nodes, options)
            self._open(nodes, columns, options)

    def pieces(self) -> Iterator[RawEvents]:
        yield from slice_columns(self.path, self._columns, self.kept_times)

    def times(self) -> Iterator[np.ndarray] | None:
        return slice_times(self.path, self._columns["t"]) if self._has_own_times else None

    def frames(self) -> RawFrames | None:
        """Return image_raw and image_raw_ts beside the events (MVSEC), or the pictures of the group
        `images`, with the attribute timestamp each (event_cnn_minimal)."""
        for name in ("image_raw", "images"):
            held = self._beside.get(name)
            if isinstance(held, h5py.Dataset) and f"{name}_ts" in self._beside:
                return wrap_frame_array(held, self._beside[f"{name}_ts"][:])
            if isinstance(held, h5py.Group) and len(held):
                pictures = [held[key] for key in sorted(held)]
                times = np.array([picture.attrs["timestamp"] for picture in pictures])
                height, width = pictures[0].shape[:2]
                read = partial(map, lambda picture: to_gray(picture[:]), pictures)
                return RawFrames(times, (height, width), read)
        return None

    def _find_columns(self, nodes: list[Any], options: ReadOptions) -> list[dict[str, Any]]:
        """Return the columns of each node; refuses before anything is read."""
        held = [node.values() if isinstance(node, h5py.Group) else [node] for node in nodes]
        parts = [part for part in chain(*held) if isinstance(part, h5py.Dataset)]
        check_unpacking_ratio(self.path, sum(part.nbytes for part in parts))
        refuse_ecf_codec(parts)
        order = options.columns
        if len(nodes) > 1 and order is None:
            order = find_order_of_windows(map(find_nameless_table, nodes))
        return [find_event_columns(node, order) for node in nodes]

    def _open(self, nodes: list[Any], columns: list[dict[str, Any]], options: ReadOptions) -> None:
        """Take the `columns` of all nodes, one after the other."""
        node = nodes[0]
        self._beside, self._has_own_times = node.parent, isinstance(node, h5py.Group)
        places = (*nodes, self._file) if self._has_own_times else (*nodes, node.parent, self._file)
        self.size, line = next(filter(None, map(_stated_size, places)), (None, ""))
        self.notes += (f"{self.path}: {line}",) if line else ()
        self._columns: dict[str, Any] = columns[0]
        if len(columns) > 1:
            parts = {name: [one[name] for one in columns] for name in "txyp"}
            self._columns = {name: ConcatenatedColumn(part) for name, part in parts.items()}
        names = node if self._has_own_times else node.dtype.names
        self.time_unit = read_units_attribute(node, options) or find_named_time_unit(names, options)
        if self.time_unit is None and options.time_unit == "auto":
            marks = self._file.get("ms_to_idx")
            if isinstance(marks, h5py.Dataset):
                check_unpacking_ratio(self.path, marks.nbytes)
                self.time_unit = find_time_unit_by_ms_to_idx(marks, self._columns["t"])


def find_streams(file: h5py.File) -> dict[str, Any]:
    """Return the groups with columns of events and the arrays of events of a file by their paths,
    in alphabetical order, those that are called events first; where there are none, those in the
    shapes of MATLAB."""
    found = _find_streams(file, False) or _find_streams(file, True)
    inside = [name for name in found if any(name.startswith(f"{other}/") for other in found)]
    names = sorted(set(found) - set(inside), key=lambda name: ("event" not in name.lower(), name))
    return {name or "/": found[name] for name in names}


def _find_streams(file: h5py.File, is_matlab: bool) -> dict[str, Any]:
    found: dict[str, Any] = {"": file} if _has_columns(file, is_matlab) else {}

    def visit(name: str, node: Any) -> None:
        if (isinstance(node, h5py.Group) and _has_columns(node, is_matlab)) or (
            isinstance(node, h5py.Dataset) and _is_table(name, node, is_matlab)
        ):
            found[name] = node

    file.visititems(visit)
    return found


def check_hdf5_safety(file: h5py.File) -> int:
    """Return the bytes of the largest chunk.

    Raises ValueError where a part of the file is another file, as a path leads anywhere, or comes
    in chunks beyond MAX_CHUNK_BYTES, which are unpacked whole.
    """
    chunks = [0]

    def visit(name: str, link: Any) -> str | None:  # an error raised in here would be lost in HDF5
        if isinstance(link, h5py.ExternalLink):
            return f"{name} leads to another file, {link.filename}"
        part = file.get(name) if isinstance(link, h5py.HardLink) else None
        if not isinstance(part, h5py.Dataset):
            return None
        if part.external or part.is_virtual:
            return f"{name} lies in another file"
        chunks.append(part.dtype.itemsize * math.prod(part.chunks) if part.chunks else 0)
        if chunks[-1] > MAX_CHUNK_BYTES:
            return f"{name} is packed in chunks of more than {MAX_CHUNK_BYTES} bytes"
        return None

    if fault := file.visititems_links(visit):
        raise ValueError(fault)
    return max(chunks)


def refuse_ecf_codec(parts: Iterable[Any]) -> None:
    """Raise ValueError where one of the datasets is packed with Prophesee's own codec."""
    for part in parts:
        plan = part.id.get_create_plist()
        if ECF_CODEC in [plan.get_filter(k)[0] for k in range(plan.get_nfilters())]:
            raise ValueError(
                "Prophesee HDF5 is packed with the vendor's own codec (ECF); export the recording "
                "as RAW (EVT3) or as events/{x,y,t,p}"
            )


def _has_columns(group: Any, is_matlab: bool) -> bool:
    """Return whether the group holds t, x, y, p in the shapes of `has_column_shape`."""
    keys = find_keys_by_name(group)
    return keys is not None and all(
        has_column_shape(key, group.get(key), is_matlab) for key in keys.values()
    )


def _is_table(name: str, node: Any, is_matlab: bool) -> bool:
    if node.dtype.names is not None:
        return node.ndim == 1 and find_keys_by_name(node.dtype.names) is not None
    is_turned = is_matlab and has_event_per_column(node)
    is_table = node.ndim == 2 and (node.shape[1] == 4 or is_turned)
    return is_table and "event" in name.lower()


def _stated_size(node: Any) -> tuple[WidthHeight, str] | None:
    """Return (width, height) as attributes or small arrays of a node, of SIZE_NAMES or SHAPE_NAMES
    or `width` and `height`, state it: `640x480`, (640, 480) or 640, 480; and what the user is told
    of it, or "".  Arrays of more than four numbers are something else."""
    known = (dict(node) if isinstance(node, h5py.Group) else {}) | dict(node.attrs)
    for name in (*SIZE_NAMES, *SHAPE_NAMES):
        sides = _whole_numbers(known[name]) if name in known else []
        if len(sides) == 2:
            if name in SIZE_NAMES or "x" in str(known[name]).lower():  # 640x480
                return (sides[0], sides[1]), ""
            if name == "resolution" and sides[0] > sides[1]:
                line = f"resolution {sides[0]}, {sides[1]} is read as width, height"
                return (sides[0], sides[1]), f"{line}; if not, give sensor_size=[height,width]"
            return (sides[1], sides[0]), ""
    width, height = (_whole_numbers(known.get(name)) for name in ("width", "height"))
    return ((width[0], height[0]), "") if len(width) == len(height) == 1 else None


def _whole_numbers(value: Any) -> list[int]:
    """Return the first two numbers of a value; none for another."""
    if isinstance(value, str | bytes):
        text = value.decode("latin-1") if isinstance(value, bytes) else value
        value = re.split(r"[\sx,;]+", text.strip().lower())
    try:
        numbers = np.asarray(value if np.size(value) <= 4 else None).ravel()[:2].astype(np.float64)
    except (TypeError, ValueError):  # words, or nothing
        return []
    return [int(n) for n in numbers.tolist() if n >= 1 and n == int(n)]
