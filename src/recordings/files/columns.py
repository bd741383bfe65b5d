"""Events in tables: text and CSV (`t x y p`), npz, and HDF5, read in pieces.

A time in seconds is told from one in microseconds by its type: floats, or text with a point, are
seconds.  HDF5 holds `x y t p` at the top or in the group `events`; the group may come with
`t_offset` in microseconds and `ms_to_idx` (Gehrig et al. 2021).
"""

import math
import zipfile
from collections.abc import Iterator, Sequence
from itertools import chain, islice
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

SUFFIXES = (".txt", ".csv", ".npz", ".h5", ".hdf5")
PIECE_EVENTS = 2**18  # events in a piece
MAX_CHUNK_BYTES = 2**28  # bytes of HDF5 that are unpacked at a time
MAX_PACKING = 200  # most that the columns of a recording shrink when they are packed
NAMES = {
    "t": ("t", "ts", "time", "timestamp"), "x": ("x", "xs"), "y": ("y", "ys"),
    "p": ("p", "ps", "on", "polarity", "pol"),
}  # fmt: skip


def iter_event_pieces(path: Path) -> Iterator[tuple]:
    """Yield (t int64 us, x, y, p) piece by piece; raises ValueError that names the file."""
    try:
        with np.errstate(invalid="raise"):
            if path.suffix in (".txt", ".csv"):
                yield from _text(path)
            else:
                yield from _columns(path)
    except Exception as error:  # libraries raise all kinds on a broken file
        raise ValueError(f"{path}: cannot be read as a table of events: {error}") from error


def read_sensor_size(path: Path) -> tuple[int, int] | None:
    """Return (width, height) where the file states it."""
    stated: Sequence | None = None
    try:
        if path.suffix in (".txt", ".csv"):
            with path.open(encoding="latin-1") as file:
                header = file.readline().replace(",", " ").split()
            sides = dict(word.split("@") for word in header if word.count("@") == 1)
            if {"x", "y"} <= set(sides):
                stated = sides["x"], sides["y"]
            elif len(header) == 2:
                stated = header
        elif path.suffix == ".npz":
            _check_packing(path)
            with np.load(path) as file:
                stated = file["size"].tolist() if "size" in file else None
        else:
            with h5py.File(path) as file:
                stated = file.attrs.get("size")
                if stated is None and "sensor_resolution" in file.attrs:
                    stated = file.attrs["sensor_resolution"][::-1]
        return None if stated is None else (int(stated[0]), int(stated[1]))
    except Exception as error:  # libraries raise all kinds on a broken file
        raise ValueError(f"{path}: cannot be read as a table of events: {error}") from error


def _text(path: Path) -> Iterator[tuple]:
    with path.open(encoding="latin-1") as file:
        first = file.readline()
        order, data = _layout(first)
        lines = chain([first] if data else [], file)
        while block := list(islice(lines, PIECE_EVENTS)):
            seconds = "." in block[0].replace(",", " ").split()[order[0]]
            delimiter = "," if "," in block[0] else None
            table = np.loadtxt(block, np.float64, delimiter=delimiter, ndmin=2, usecols=order)
            if len(table):
                yield _us(table[:, 0], seconds), *_pixels(*table[:, 1:].T)


def _layout(line: str) -> tuple[list[int], bool]:
    """Return the places of t, x, y, p in a line, and whether the line is data already."""
    words = line.replace(",", " ").lower().lstrip("#").split()
    bare = [word.split("@")[0] for word in words]
    try:
        float(words[0])
        if len(words) == 2:  # width and height
            return [0, 1, 2, 3], False
        if len(words) < 4:
            raise ValueError(f"a line must be `t x y p`, got {line.strip()[:40]!r}")
        return [0, 1, 2, 3], True
    except (ValueError, IndexError):
        places = [[i for i, w in enumerate(bare) if w in NAMES[name]] for name in "txyp"]
        if not all(places):
            raise ValueError(f"no columns t x y p in {line.strip()[:40]!r}") from None
        return [place[0] for place in places], False


def _columns(path: Path) -> Iterator[tuple]:
    if path.suffix == ".npz":
        _check_packing(path)
        with np.load(path) as file:
            yield from _sliced(file, 0)
        return
    with h5py.File(path) as file:
        check_no_external_data(file)
        if "CD" in file:
            raise ValueError(
                "Prophesee HDF5 (CD/events) is packed with the vendor's own codec; export the "
                "recording as RAW (EVT3) or as events/{x,y,t,p}"
            )
        columns = file.get("events", file)
        parts = [part for part in columns.values() if isinstance(part, h5py.Dataset)]
        _check_claim(path, sum(part.nbytes for part in parts))
        stated = file.get("t_offset")
        if stated is not None and stated.size != 1:
            raise ValueError(f"t_offset must be one number, got {stated.shape}")
        yield from _sliced(columns, 0 if stated is None else int(np.asarray(stated).item()))


def check_no_external_data(file: h5py.File) -> None:
    """Raise ValueError where a part of the file is another file, as a path leads anywhere, or comes
    in chunks beyond MAX_CHUNK_BYTES, which are unpacked whole.
    """

    def visit(name: str, link) -> str | None:  # an error raised in here would be lost in HDF5
        if isinstance(link, h5py.ExternalLink):
            return f"{name} leads to another file, {link.filename}"
        part = file.get(name) if isinstance(link, h5py.HardLink) else None
        if not isinstance(part, h5py.Dataset):
            return None
        if part.external or part.is_virtual:
            return f"{name} lies in another file"
        if part.dtype.itemsize * math.prod(part.chunks or ()) > MAX_CHUNK_BYTES:
            return f"{name} is packed in chunks of more than {MAX_CHUNK_BYTES} bytes"
        return None

    if fault := file.visititems_links(visit):
        raise ValueError(fault)


def _check_packing(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        _check_claim(path, sum(part.file_size for part in archive.infolist()))


def _check_claim(path: Path, size: int) -> None:
    """Raise ValueError for a file that unpacks to more than MAX_PACKING times its size."""
    most = MAX_PACKING * path.stat().st_size + 2**24
    if size > most:
        raise ValueError(f"it unpacks to {size} bytes, more than the {most} believed")


def _sliced(group, offset: int) -> Iterator[tuple]:
    """Yield slices of the columns of a mapping."""
    keys = {name: next((key for key in NAMES[name] if key in group), None) for name in "txyp"}
    missing = [name for name, key in keys.items() if key is None]
    if missing:
        raise ValueError(f"no column {', '.join(missing)} among {', '.join(group.keys())}")
    t, x, y, p = (group[keys[name]] for name in "txyp")
    if any(column.ndim != 1 for column in (t, x, y, p)):
        raise ValueError("columns must have one dimension")
    if not len(t) == len(x) == len(y) == len(p):
        raise ValueError(f"columns differ in length: {len(t)}, {len(x)}, {len(y)}, {len(p)}")
    for i in range(0, len(t), PIECE_EVENTS):
        part = slice(i, i + PIECE_EVENTS)
        time = np.asarray(t[part])
        yield _us(time, time.dtype.kind == "f") + offset, *_pixels(x[part], y[part], p[part])


def _us(t: NDArray, seconds: bool) -> NDArray[np.int64]:
    t = np.rint(t * 1e6) if seconds else t
    if not np.isfinite(t).all() or np.abs(t).max(initial=0) > 2**62:
        raise ValueError("times must be finite")
    return t.astype(np.int64)


def _pixels(x, y, p) -> tuple[NDArray[np.uint16], NDArray[np.uint16], NDArray]:
    for name, part in (("x", x), ("y", y)):
        if len(part) and (np.min(part) < 0 or np.max(part) > 65535):
            raise ValueError(f"{name} must be in 0..65535, got {np.min(part)} to {np.max(part)}")
    if not np.isin(p, (-1, 0, 1)).all():
        raise ValueError(f"polarity must be in {{0, 1}} or {{-1, 1}}, got {np.unique(p)[:4]}")
    return np.asarray(x).astype(np.uint16), np.asarray(y).astype(np.uint16), np.asarray(p)
