"""Columns of tables of events: which is which, by name or by values, and their types."""

import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.engines.event_passes import MAX_COORDINATE
from src.recordings.files.event_file import ReadOptions

MAX_PACKING = 200  # most that the columns of a recording shrink when they are packed
IN_ORDER = 0.99  # of the steps of a column that time may be
DATES = "mM"  # the kinds of NumPy's timedelta64 and datetime64
NAMES = {
    "t": ("t", "ts", "time", "times", "timestamp", "timestamps"),
    "x": ("x", "xs", "col", "column", "x_coord", "x_coordinate", "x-coordinate", "u"),
    "y": ("y", "ys", "row", "y_coord", "y_coordinate", "y-coordinate", "v"),
    "p": ("p", "ps", "on", "polarity", "polarities", "pol"),
}  # fmt: skip
JOINT = "xy"  # a column (n, 2) of both
SECONDS = r"(?:n|nano|u|µ|μ|micro|m|milli)?s(?:ec(?:ond)?s?)?"  # of times: us, nsec, seconds, ...
UNIT = re.compile(rf"[ _]?[\[(]?({SECONDS}|px|pixel|pixels)[\])]?$")
TIME_UNIT = re.compile(rf"[ _\[(]({SECONDS})[\])]?$")
NAME = re.compile(r"[A-Za-z][\w.@-]*( ?[\[(][^\])]*[\])])?")  # one word, its unit in brackets
BETWEEN_PARTS = re.compile(r"[\W_]+|(?<=[a-z])(?=[A-Z])")
OTHER_TIMES = {"exposure", "start", "end", "frame", "delta"}  # `start_time` is not of events


def find_columns_by_name(names: Sequence[str]) -> dict[str, int] | None:
    """Return the place of t, x, y and p among column names of any case, or None.

    A name may end in its unit (`timestamp_us`) or state the sensor's side (`x@640`).
    """
    bare = [_bare(name).split("@")[0] for name in names]
    places = {}
    for letter, known in NAMES.items():
        plain = [name if name in known else UNIT.sub("", name) for name in bare]
        found = [word for word in known if word in plain]
        if not found:
            return None
        places[letter] = plain.index(found[0])
    return places


def find_candidate_columns(names: Sequence[str]) -> dict[str, list[int]]:
    """Return the places among column names, a word each, where t, x, y and p are a part of the name
    (`event_t`, `pos.y`) or names are alike but for x and y (`xpos`, `ypos`); none in a sentence."""
    if not all(map(NAME.fullmatch, names)):
        return {letter: [] for letter in NAMES}
    parts = [{part.lower() for part in BETWEEN_PARTS.split(name)} for name in names]
    found = {
        letter: [place for place, own in enumerate(parts) if own & set(known)]
        for letter, known in NAMES.items()
    }
    found["t"] = [place for place in found["t"] if not parts[place] & OTHER_TIMES]
    if not found["x"] and not found["y"]:
        bare = [_bare(name) for name in names]
        twins = [(name, name.replace("x", "y")) for name in bare if "x" in name]
        twins = [(x, y) for x, y in twins if y in bare]
        found |= {"xy"[side]: [bare.index(twin[side]) for twin in twins] for side in (0, 1)}
    return found


def find_columns_by_part(names: Sequence[str]) -> dict[str, int] | None:
    """Return the places of t, x, y and p by `find_candidate_columns`, or None if not one each."""
    found = find_candidate_columns(names)
    places = {letter: alike[0] for letter, alike in found.items() if len(alike) == 1}
    return places if len(set(places.values())) == len(NAMES) else None


def find_time_column_names(names: Iterable[str]) -> list[str]:
    """Return which of the names may be the times of events."""
    return [name for name in names if {_bare(name), UNIT.sub("", _bare(name))} & {*NAMES["t"]}]


def require_one_time_column(times: Sequence[str], *, of_a_table: bool = False) -> None:
    """Raise ValueError for several names of columns that may be the times; seconds and their
    fraction are left to `parse_time_column_unit`.  `of_a_table`: `columns=` may choose one."""
    if len(times) > 1 and "s" not in map(parse_unit_suffix, times):
        way = "rename one, or give columns=" if of_a_table else "rename one"
        raise ValueError(f"times must be one column, got {', '.join(times)}; {way}")


def find_keys_by_name(names: Iterable[str]) -> dict[str, str] | None:
    """Return the names of t, x, y and p among `names`, or None; that of x and y may be JOINT."""
    keys = list(names)
    joint = [*JOINT] if JOINT in keys else []
    places = find_columns_by_name([*keys, *joint])
    keys += len(joint) * [JOINT]
    return None if places is None else {letter: keys[place] for letter, place in places.items()}


def extract_column(letter: str, key: str, values: np.ndarray) -> np.ndarray:
    """Return the column `letter` of the array that is called `key`; ValueError for a JOINT that is
    not (n, 2)."""
    if key != JOINT:
        return values
    if values.ndim != 2 or values.shape[1] != len(JOINT):
        raise ValueError(f"{JOINT} must be (n, 2), got {values.shape}")
    return values[:, JOINT.index(letter)]


def parse_unit_suffix(name: str) -> str | None:
    """Return the unit that the name of a column of times ends in (`t_ns`, `time [ms]`), or None."""
    found = TIME_UNIT.search(_bare(name))
    return None if found is None else _short_unit(found[1])


def find_time_unit_in_text(text: str) -> str | None:
    """Return the unit of time that a text states (`us`, `time in micro seconds`), or None; a number
    before it would be a part of it."""
    text = re.sub(r"\b(nano|micro|milli)[ -]+s", r"\1s", text.lower())
    found = re.search(rf"(?<![^\W\d_]){SECONDS}(?![^\W\d_])", text)
    if found is None or re.search(r"\d", text[: found.start()]):
        return None
    return _short_unit(found[0])


def parse_time_column_unit(names: Sequence[str], key: str) -> str | None:
    """Return the unit that `key`, the name of the times among `names`, ends in, or None; raises
    ValueError where these are seconds and another column has the fraction, or the time once more.
    """
    unit = parse_unit_suffix(key)
    finer = [
        name for name in names
        if parse_unit_suffix(name) not in (None, "s")
        and TIME_UNIT.sub("", _bare(name)).rstrip() in NAMES["t"]
    ]  # fmt: skip
    if unit == "s" and finer:
        both = ", ".join([key, *finer])
        way = f"add them up, or give time_unit=s where {key} is the whole time"
        raise ValueError(f"times must be one column, got {both}; {way}")
    return unit


def find_named_time_unit(names: Iterable[str] | None, options: ReadOptions) -> str | None:
    """Return the unit that the name of the times among `names` ends in; None where it has none or
    `options` state the unit or the columns.  Raises ValueError as `parse_time_column_unit` does."""
    listed = list(names or ())
    keys = find_keys_by_name(listed)
    if keys is None or options.time_unit != "auto" or options.columns is not None:
        return None
    return parse_time_column_unit(listed, keys["t"])


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


def _bare(name: str) -> str:
    return name.strip().strip("\"'").lower()


def _short_unit(word: str) -> str:
    is_us = word.startswith(("u", "µ", "μ", "micro"))
    return "us" if is_us else {"n": "ns", "m": "ms", "s": "s"}[word[0]]


def _is_coordinate(values: np.ndarray) -> bool:
    if not np.isfinite(values).all():
        return False
    in_range = (values >= 0) & (values <= MAX_COORDINATE)
    return bool((in_range & (np.rint(values) == values)).all())


def _is_in_order(values: np.ndarray) -> bool:
    steps = np.diff(values)
    return bool(len(steps) and (steps >= 0).mean() >= IN_ORDER and values[-1] > values[0])
