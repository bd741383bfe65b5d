"""Columns of tables of events by their values: which is which, their types and lengths."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.engines.event_passes import MAX_COORDINATE

MAX_PACKING = 200  # most that the columns of a recording shrink when they are packed
IN_ORDER = 0.99  # of the steps of a column that time may be
DATES = "mM"  # the kinds of NumPy's timedelta64 and datetime64


def find_columns_by_values(sample: np.ndarray) -> dict[str, int]:
    """Return the places of t, x, y and p in a table without names, by its values (rows, columns).

    Polarity is -1, 0 or 1 throughout; coordinates are whole numbers in 0..65535; time is what
    cannot be one of these, or the only column that is in order; x stands before y.  Raises
    ValueError, which names `columns`, where more than one or no reading is possible.
    """
    width = sample.shape[1]
    signs = [k for k in range(width) if np.isin(sample[:, k], (-1, 0, 1)).all()]
    whole = [k for k in range(width) if _is_coordinate(sample[:, k])]
    times = [k for k in range(width) if k not in whole and k not in signs]
    if not times:
        free = [k for k in range(width) if k not in signs]
        times = [k for k in free if _is_in_order(sample[:, k])]
    if width == 4 and len(times) == len(signs) == 1:
        x, y = (k for k in range(4) if k not in (*times, *signs))
        if {x, y} <= set(whole):
            return {"t": times[0], "x": x, "y": y, "p": signs[0]}
    if times and not signs and len(whole) + len(times) >= width:
        raise ValueError(
            f"polarity must be -1, 0 or 1: none of the {width} columns has such values only"
        )
    fitting = len({*whole, *signs})
    if width > 3 > fitting:
        raise ValueError(
            "x and y must be whole numbers from 0 on, polarity -1, 0 or 1: only "
            f"{fitting} of {width} columns can be one of these (rectified places are not read)"
        )
    raise ValueError(
        f"columns must say the order of the {width} columns, such as columns=txyp or "
        f"columns=xypt: {len(times)} can be time and {len(signs)} polarity"
    )


def find_columns(sample: np.ndarray, order: str | None) -> dict[str, int]:
    """Return the places of t, x, y and p: as `order` (columns=) states them, or by the values.

    Raises ValueError for a table too narrow for `order`, or as `find_columns_by_values`.
    """
    if order is None:
        return find_columns_by_values(sample)
    places = {letter: order.index(letter) for letter in "txyp"}
    if len(order) > (width := sample.shape[1]):
        raise ValueError(f"columns must name columns of a table of {width}, got {order}")
    return places


def as_times(t: np.ndarray) -> np.ndarray:
    """Return times as contiguous int64 or float64, NumPy's dates and durations as int64 in us;
    raises ValueError for another kind of values."""
    if t.dtype.kind in DATES:
        if np.datetime_data(t.dtype)[0] == "generic" or np.isnat(t).any():
            raise ValueError(f"times must have a unit and a value each, got {t.dtype}")
        return np.ascontiguousarray(t.astype(f"{t.dtype.kind}8[us]").astype(np.int64))
    if t.dtype.kind == "f":
        return np.ascontiguousarray(t, np.float64)
    if t.dtype.kind not in "iu":
        raise ValueError(f"times must be numbers, got {t.dtype}")
    if t.dtype == np.uint64 and t.size and t.max() >= 2**63:
        raise ValueError(f"times must be below 2^63, got {t.max()}")
    return np.ascontiguousarray(t, np.int64)


def as_integers(name: str, values: np.ndarray) -> np.ndarray:
    """Return the values of column `name` as integers; raises ValueError for others, NaN too."""
    if values.dtype.kind in "iub":
        return np.asarray(values)
    if values.dtype.kind != "f":
        raise ValueError(f"{name} must be numbers, got {values.dtype}")
    wrong = ~(np.rint(values) == values)
    if wrong.any():
        raise ValueError(f"{name} must be whole numbers, got {values[wrong][0]}")
    if values.size and float(np.abs(values).max()) > 2**31:  # float16 cannot hold the bound
        raise ValueError(f"{name} must be in 0..{MAX_COORDINATE}, got {np.abs(values).max():.0f}")
    return values.astype(np.int64)


def check_lengths(columns: Mapping[str, Any]) -> None:
    """Raise ValueError unless the columns t, x, y, p are equally long."""
    lengths = [len(columns[name]) for name in "txyp"]
    if len(set(lengths)) != 1:
        raise ValueError(f"columns t, x, y, p differ in length: {lengths}")


def check_unpacking_ratio(path: Path, unpacked_bytes: int) -> None:
    """Raise ValueError for a file that unpacks to more than MAX_PACKING times its size."""
    most = MAX_PACKING * path.stat().st_size + 2**24
    if unpacked_bytes > most:
        raise ValueError(f"it unpacks to {unpacked_bytes} bytes, more than the {most} believed")


def _is_coordinate(values: np.ndarray) -> bool:
    if not np.isfinite(values).all():
        return False
    in_range = (values >= 0) & (values <= MAX_COORDINATE)
    return bool((in_range & (np.rint(values) == values)).all())


def _is_in_order(values: np.ndarray) -> bool:
    steps = np.diff(values)
    return bool(len(steps) and (steps >= 0).mean() >= IN_ORDER and values[-1] > values[0])
