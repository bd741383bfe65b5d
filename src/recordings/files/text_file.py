"""Events as text, a line each: CSV and its relatives, also packed as .gz or .zip.

Before the events there may be comments (# % // ;), a line `width height`, `%geometry:640,480`, and
the names of the columns.  Values are separated by spaces, tabs, semicolons (then a comma may be the
decimal point), commas or several of these, and may have quotes; polarity is 0 / 1, -1 / 1, True /
False or ON / OFF.
"""

import re
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured

from src.recordings.engines.event_passes import MAX_COORDINATE
from src.recordings.files.column_names import (
    find_time_column_names,
    parse_time_column_unit,
    require_one_time_column,
)
from src.recordings.files.column_values import as_integers, check_unpacking_ratio, find_columns
from src.recordings.files.event_file import (
    EventFile,
    RawEvents,
    RawFrames,
    ReadOptions,
    name_file_in_errors,
)
from src.recordings.files.frame_files import find_listed_frames
from src.recordings.files.lazy_columns import slice_columns, slice_times
from src.recordings.files.text_layout import (
    COMMENTS,
    CUT,
    MAX_LINE,
    QUOTES,
    TO_BLANKS,
    WORDS,
    TextLayout,
    is_number,
    open_text,
    read_layout,
    split_line,
)

CHUNK = 2**22  # characters read at a time
SPOOL = np.dtype(
    [("whole_t", "i8"), ("float_t", "f8"), ("x", "u2"), ("y", "u2"), ("p", "i1")], align=True
)


class TextFile(EventFile):
    """A text file, read once into a temporary file of binary columns.

    Raises ValueError for a line that cannot be read, with its number; a last line that is cut is
    left out, with a note.
    """

    def __init__(self, path: Path, options: ReadOptions):
        self.path, self.notes, self._places = path, (), None
        with name_file_in_errors(path, "cannot be read as text of events"):
            with open_text(path) as file:
                self._layout = read_layout(file)
            self.size = self._layout.size
            if options.columns is None:
                self._use_names(options)
            elif self._layout.width:
                none = np.empty((0, self._layout.width))
                self._places = find_columns(none, options.columns)
            self._columns = self._read()

    def pieces(self) -> Iterator[RawEvents]:
        yield from slice_columns(self.path, self._columns)

    def times(self) -> Iterator[np.ndarray]:
        yield from slice_times(self.path, self._columns["t"])

    def frames(self) -> RawFrames | None:
        return find_listed_frames(self.path.parent / "images.txt")

    def _use_names(self, options: ReadOptions) -> None:
        """Take the places of the columns, and the unit of time, from their names; raises ValueError
        for names that are not known, but put y before x."""
        layout = self._layout
        self._places, header = layout.column_places, (layout.unknown_header or "")[:60]
        if layout.has_y_first:
            raise ValueError(f"columns must say which are t, x, y and p, {header!r} does not")
        if header:
            self.notes += (
                f"{self.path}: the names in {header!r} are not known, "
                "columns are told by their values; if these are others, give columns=",
            )
        if self._places is not None:
            require_one_time_column(find_time_column_names(layout.names), of_a_table=True)
        if self._places is not None and options.time_unit == "auto":
            self.time_unit = parse_time_column_unit(layout.names, layout.names[self._places["t"]])

    def _read(self) -> dict[str, np.ndarray]:
        """Return the columns t, in the file's unit, x, y, p (n,), as they stand in the file."""
        with _Spool() as spool:
            for block, number, is_last in self._blocks():
                table = self._parse(block, number, is_last)
                if not len(table):
                    continue
                if self._places is None:
                    values = structured_to_unstructured(table, np.float64)
                    self._places = find_columns(values, None)
                spool.add(*(table[f"f{self._places[name]}"] for name in "txyp"))
            return spool.mapped()

    def _blocks(self) -> Iterator[tuple[str, int, bool]]:
        """Yield lines of events, how many come before them, and whether they end the file."""
        number, rest, size = self._layout.header_lines, "", 0
        with open_text(self.path) as file:
            for _ in range(number):
                file.readline(MAX_LINE)
            while chunk := file.read(CHUNK):
                size += len(chunk)
                check_unpacking_ratio(self.path, size)
                if len(chunk) < CHUNK:  # the end: these are the last lines
                    break
                body, newline, rest = (rest + chunk).rpartition("\n")
                if not newline:
                    raise ValueError(f"line {number + 1} has more than {CHUNK} characters")
                yield body, number, False
                number += body.count("\n") + 1
        if rest or chunk:
            yield (rest + chunk).rstrip("\n"), number, True

    def _parse(self, text: str, number: int, is_last: bool) -> np.ndarray:
        """Return the values of the lines as a structured array of columns f0, f1, ..."""
        tidy = self._tidy(text)
        for kind in (np.int64, np.float64):
            try:
                return _load(tidy, self._layout, kind)
            except ValueError:
                continue
        if (filled := self._fill_blanks(tidy)) != tidy:
            return self._parse("\n".join(filled), number, is_last)
        wrong = self._find_broken(tidy)
        if is_last and wrong == len(tidy) - 1 and number + wrong > self._layout.header_lines:
            cut = "gzip stream is cut, what follows is missing"
            is_packed = tidy[wrong].endswith(CUT.decode())
            self.notes += (
                f"{self.path}: its {cut if is_packed else 'last line is cut, left out'}",
            )
            return self._parse("\n".join(tidy[:-1]), number, False)
        raise ValueError(f"line {number + wrong + 1} is no event: {tidy[wrong][:40]!r}")

    def _fill_blanks(self, lines: list[str]) -> list[str]:
        """Return the lines with 0 for what is blank in columns that are not read."""
        used = range(self._layout.width) if self._places is None else self._places.values()

        def fill(line: str) -> str:
            words = line.split(self._layout.separator)
            if len(words) != self._layout.width:
                return line
            filled = (w if w.strip() or k in used else "0" for k, w in enumerate(words))
            return str(self._layout.separator).join(filled)

        return [fill(line) for line in lines] if self._layout.separator else lines

    def _find_broken(self, lines: list[str]) -> int:
        for place, line in enumerate(lines):
            words = split_line(line, self._layout.separator)
            if line and not (len(words) == self._layout.width and all(map(is_number, words))):
                return place
        raise ValueError("a number is out of range")

    def _tidy(self, text: str) -> list[str]:
        """Return the lines with points, numbers for words, and blank for comments."""
        if '"' in text or "'" in text:
            text = text.translate(QUOTES)
        if self._layout.has_decimal_comma:
            text = text.replace(",", ".")
        if self._layout.is_mixed:
            text = text.translate(TO_BLANKS)
        if self._layout.has_words:
            text = re.sub(
                r"\b(true|false|on|off)\b", lambda m: WORDS[m[0].lower()], text, flags=re.I
            )
        tidy = text.split("\n")
        if any(mark in text for mark in ("#", "%", "/")):
            tidy = ["" if line.lstrip().startswith(COMMENTS) else line for line in tidy]
        return tidy


def _load(lines: list[str], layout: TextLayout, kind: type) -> np.ndarray:
    """Return the columns of lines, all of them as `kind`; raises ValueError for other lines."""
    dtype = [(f"f{k}", kind) for k in range(layout.width)]
    if not any(lines):
        return np.empty(0, dtype)
    return np.loadtxt(lines, dtype, comments=None, delimiter=layout.separator, ndmin=1)


class _Spool:
    """Events in a temporary file; times are integers as long as all of them are."""

    def __init__(self) -> None:
        self.file = tempfile.TemporaryFile()  # noqa: SIM115 - closed by __exit__
        self.times, self.count = "whole_t", 0

    def __enter__(self) -> "_Spool":
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()  # what is mapped stays

    def add(self, t: np.ndarray, x: np.ndarray, y: np.ndarray, p: np.ndarray) -> None:
        """Add columns; raises ValueError for a place or polarity that is none."""
        events = np.zeros(len(t), SPOOL)
        events["float_t"] = t
        if t.dtype.kind == "f":
            self.times = "float_t"
        else:
            events["whole_t"] = t
        for name, column in (("x", x), ("y", y)):
            values = as_integers(name, column)
            low, high = values.min(), values.max()
            if low < 0 or high > MAX_COORDINATE:
                raise ValueError(f"{name} must be in 0..{MAX_COORDINATE}, got {low} to {high}")
            events[name] = values
        sign = as_integers("polarity", p)
        if sign.min() < -1 or sign.max() > 1:
            raise ValueError(f"polarity must be -1, 0 or 1, got {np.unique(sign)[:4].tolist()}")
        events["p"] = sign
        self.file.write(events.tobytes())
        self.count += len(events)

    def mapped(self) -> dict[str, np.ndarray]:
        """Return the columns t, x, y, p (n,) of the events."""
        self.file.flush()
        events = (
            np.memmap(self.file, SPOOL, "r", shape=self.count) if self.count else np.empty(0, SPOOL)
        )
        return {"t": events[self.times], **{name: events[name] for name in "xyp"}}
