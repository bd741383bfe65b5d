"""Columns of tables of events by their names: which is which, and the unit of time."""

import re
from collections.abc import Iterable, Sequence

import numpy as np

from src.recordings.files.event_file import ReadOptions

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


def _bare(name: str) -> str:
    return name.strip().strip("\"'").lower()


def _short_unit(word: str) -> str:
    is_us = word.startswith(("u", "µ", "μ", "micro"))
    return "us" if is_us else {"n": "ns", "m": "ms", "s": "s"}[word[0]]
