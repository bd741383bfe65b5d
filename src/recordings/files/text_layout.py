"""The layout of a text file of events, from its first lines: separator, columns, sensor size."""

import gzip
import io
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

from src.recordings.files.columns import NAMES, find_columns_by_name, parse_unit_suffix
from src.recordings.files.event_file import WidthHeight

TEXT_ENDINGS = (".txt", ".csv", ".tsv")
MAX_LINE = 2**23  # characters; a longer line is none of events
MAX_HEADER_LINES = 1000
COMMENTS = ("#", "%", "//", ";")
WORDS = {"true": "1", "false": "0", "on": "1", "off": "0"}  # of polarity
CUT = b" cut"  # what a packed text ends in where its file is cut: its last line is no event
TITLE = re.compile(r"^(?:columns?|format|order|fields|header)\s*[:=]\s*", re.IGNORECASE)
LEAST_SIDE = 16  # px, of a sensor whose size stands alone in a comment
TO_BLANKS = str.maketrans({",": " ", ";": " ", '"': " ", "'": " "})
GEOMETRY = re.compile(
    r"(?:geometry|resolution|(?<!pixel )(?<!buffer )(?<!pixel_)(?<!buffer_)size)\D*(?<![\d.])(\d+)"
    r"(?:\s*(?:(?:[x,;*]|by|height)[\s=:]*)+|\s+)(\d+)(?!\d|\.\d)",
    re.IGNORECASE,
)


class TextLayout(NamedTuple):
    """How the lines of a file are read: the `width` of the table, `separator` (None: any blanks),
    whether a comma is the decimal point, whether separators are mixed, a line ends in one or values
    have quotes (TO_BLANKS), whether polarity is a word, the `column_places` of t,
    x, y, p where names tell them, the unit of time in these, and (width, height).  `header_lines`
    come before the events; `unknown_header`: one that seems to name columns, but not all."""

    width: int
    separator: str | None
    has_decimal_comma: bool
    is_mixed: bool
    has_words: bool
    column_places: dict[str, int] | None
    time_unit: str | None
    size: WidthHeight | None
    header_lines: int
    unknown_header: str | None = None


@contextmanager
def open_text(path: Path) -> Iterator[io.TextIOBase]:
    """Open a text file, or the one in a .gz or .zip, without its byte-order mark."""
    with _open_bytes(path) as file:
        start = file.peek(4)[:4]
        if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise ValueError("it is UTF-16; save it as UTF-8")
        if start[:3] == b"\xef\xbb\xbf":
            file.read(3)
        yield io.TextIOWrapper(file, encoding="latin-1")


@contextmanager
def _open_bytes(path: Path) -> Iterator[Any]:
    ending = path.suffix.lower()
    if ending == ".gz":
        with gzip.open(path) as file:
            yield io.BufferedReader(_UpToCut(file))
    elif ending == ".zip":
        with zipfile.ZipFile(path) as archive:
            names = [n for n in archive.namelist() if n.lower().endswith(TEXT_ENDINGS)]
            names = [n for n in names if not Path(n).name.startswith("._")]  # of macOS
            named = [n for n in names if Path(n).stem.lower() == "events"]  # beside images.txt
            names = names if len(names) == 1 else named
            if len(names) != 1:
                raise ValueError("a .zip must hold one text file, or one that is called events.txt")
            with archive.open(names[0]) as file:
                yield io.BufferedReader(file)  # type: ignore[arg-type]
    else:
        with path.open("rb") as file:
            yield file


class _UpToCut(io.RawIOBase):
    """What a .gz holds; of one that is cut, what is whole and CUT."""

    def __init__(self, file: gzip.GzipFile):
        self._file, self._is_cut = file, False

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        try:
            part = b"" if self._is_cut else self._file.read1(len(buffer))
        except EOFError:
            part, self._is_cut = CUT, True
        buffer[: len(part)] = part
        return len(part)


def read_layout(file: io.TextIOBase) -> TextLayout:
    """Return how the lines are read, from those up to the first event."""
    size: WidthHeight | None = None
    names: list[str] | None = None
    strange: str | None = None
    unknown: str | None = None
    for number in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE)
        if not line:
            if strange is not None:
                raise ValueError(f"no line of numbers t x y p in it, got {strange[:40]!r}")
            return TextLayout(0, None, False, False, False, None, None, size, number)
        bare = line.strip()
        separator, has_decimal_comma = _find_separator(bare)
        plain = bare.replace(",", ".") if has_decimal_comma else bare
        if is_mixed := _has_mixed_separators(plain, separator):
            plain, separator = plain.translate(TO_BLANKS), None
        words = split_line(plain, separator)
        if len(words) >= 4 and all(map(_is_value, words)):
            has_words = not all(map(is_number, words))
            if names is not None and len(names) != len(words):
                names = None
            places = None if names is None else find_columns_by_name(names)
            unit = parse_unit_suffix(names[places["t"]]) if names and places else None
            how = separator, has_decimal_comma, is_mixed, has_words
            return TextLayout(
                len(words), *how, places, unit, size, number, None if places else unknown
            )
        here = _stated_size(bare)
        size = size or here
        title = bare.lstrip("#%/; ").encode("latin-1").decode(errors="replace")  # it may have µs
        found = _split_title(title)
        unknown = bare if len(found) == 4 and not here and _names_some(found) else unknown
        names = found if find_columns_by_name(found) else names
        if bare and not (bare.startswith(COMMENTS) or here or find_columns_by_name(found)):
            strange = strange or bare
    raise ValueError(f"no line of numbers t x y p among the first {MAX_HEADER_LINES}")


def _stated_size(line: str) -> WidthHeight | None:
    """Return (width, height) of `640 480`, `%geometry:640,480` or `t x@640 y@480 p`."""
    sides = dict(re.findall(r"\b([xy])@(\d+)", line))
    if len(sides) == 2:
        return int(sides["x"]), int(sides["y"])
    if match := GEOMETRY.search(line):
        return int(match[1]), int(match[2])
    alone = re.fullmatch(r"(\d+)[\s,;x]+(\d+)", line.lstrip("#% "))
    if alone is None or (line[0] in "#%" and min(int(alone[1]), int(alone[2])) < LEAST_SIDE):
        return None
    return int(alone[1]), int(alone[2])


def _split_title(title: str) -> list[str]:
    """Return the names of columns in a line such as `t,x,y,p`, `columns: [t | y | x | p]` or
    `time (float s), x, y, polarity (0=off)`."""
    title = TITLE.sub("", title)
    bare = re.sub(r"[\[\](){}]", "", title).replace("|", ",").strip()
    for line in (title, bare, re.sub(r"\([^)]*\)", "", title).strip()):
        names = [name.strip() for name in split_line(line, _find_separator(line)[0])]
        if find_columns_by_name(names):
            break
    return names


def _names_some(names: list[str]) -> bool:
    """Return whether two or more of the columns are known by name."""
    plain = [re.split(r"[^a-zµ]", name.lower())[0] for name in names]
    return sum(any(name in known for name in plain) for known in NAMES.values()) >= 2


def _find_separator(line: str) -> tuple[str | None, bool]:
    """Return what separates values (None: blanks), and whether a comma is the decimal point."""
    if ";" in line.lstrip("; "):
        return ";", "," in line
    if len(line.split()) >= 4 and re.search(r"\d,\d", line):
        return None, True
    return ("," if "," in line else None), False


def _has_mixed_separators(line: str, separator: str | None) -> bool:
    """Return whether values have quotes, or more than `separator` stands between or behind them."""
    if '"' in line or "'" in line:
        return True
    values = line.split(separator)
    return separator is not None and (not values[-1] or any(len(v.split()) > 1 for v in values))


def split_line(line: str, separator: str | None) -> list[str]:
    """Return the values of a line; `separator` None: any blanks."""
    words = line.strip().split(separator)
    while separator and words and not words[-1].strip():  # a separator at the end of the line
        words.pop()
    return words


def is_number(word: str) -> bool:
    """Return whether a word is a number as text files have them."""
    try:
        float(word)
    except ValueError:
        return False
    return "_" not in word


def _is_value(word: str) -> bool:
    return word.strip().lower() in WORDS or is_number(word)
