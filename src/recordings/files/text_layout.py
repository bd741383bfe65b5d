"""The layout of a text file of events, from its first lines: separator, columns, sensor size."""

import gzip
import io
import re
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path, PureWindowsPath
from typing import Any, NamedTuple

from src.recordings.files.column_names import (
    NAMES,
    SECONDS,
    find_candidate_columns,
    find_columns_by_name,
    find_columns_by_part,
)
from src.recordings.files.event_file import WidthHeight

TEXT_ENDINGS = (".txt", ".csv", ".tsv")
MAX_LINE = 2**23  # characters; a longer line is none of events
MAX_HEADER_LINES = 1000
COMMENTS = ("#", "%", "//", ";")
WORDS = {"true": "1", "false": "0", "on": "1", "off": "0"}  # of polarity
CUT = b" cut"  # what a packed text ends in where its file is cut: its last line is no event
TITLE = re.compile(r"^(?:columns?|format|order|fields|header)\s*[:=]\s*", re.IGNORECASE)
IN_PROSE = {"t": NAMES["t"], "x": ("x", "xs"), "y": ("y", "ys"), "p": ("p", "pol", "polarity")}
LETTERS = {name: letter for letter, names in IN_PROSE.items() for name in names}
# A name as in `t`, `t [us]`, `<t>` or `t=timestamp`, and what stands between two of a list.
LISTED = re.compile(
    rf"(?<![^\W_])({'|'.join(map(re.escape, LETTERS))})(?![^\W_])"
    r"(?:\s{0,9}=\s{0,9}[a-z]+)?(?:\s{0,9}[\[(]\s{0,9}[a-z]+\s{0,9}[\])])?"
)
BETWEEN = re.compile(r"[\s,;|/<>()\[\]_-]+")
LEAST_SIDE = 16  # px, of a sensor whose size stands alone in a comment
TO_BLANKS = str.maketrans({",": " ", ";": " "})
QUOTES = str.maketrans("", "", "\"'")
HEIGHT, WIDTH = r"\b(?:height|h|rows?)\b", r"\b(?:width|w|columns?|cols?)\b"
HEIGHT_FIRST = re.compile(rf"{HEIGHT}\s{{0,9}}(?:[,x*]|by|\s)\s{{0,9}}{WIDTH}", re.IGNORECASE)
# What a size may be of that is none of the sensor, and units that such a one has.
OTHERS = (
    r"(?:file|chunk|pixel|buffer|batch|block|window|page|packet|memory|screen|header|"
    r"time(?:stamp)?|temporal)"
)
UNIT = r"(?:bytes|[kmg]b|[nuµm][ms])"
GEOMETRY = re.compile(
    rf"(?:geometry|resolution|size)(\D{{0,80}})(?<![\d.])(\d+)"
    rf"(?:\s{{0,9}}(?:(?:[x,;*]|by|height|width)[\s=:]{{0,9}}){{1,3}}|\s{{1,9}})(\d+)"
    rf"(?!\d|\.\d|\s{{0,9}}{UNIT}\b)[)\]]?(?:\s{{0,9}}\(([^()]{{0,40}})\))?",
    re.IGNORECASE,
)
OF_OTHERS = re.compile(rf"{OTHERS}[\s_-]*$", re.IGNORECASE)
ARE_OTHERS = re.compile(rf"\s*of\s+(?:the\s+)?{OTHERS}\b", re.IGNORECASE)


class TextLayout(NamedTuple):
    """How the lines of a file are read: the `width` of the table, `separator` (None: any blanks),
    whether a comma is the decimal point, whether separators are mixed or a line ends in one
    (TO_BLANKS), whether polarity is a word, the `names` of the columns and the `column_places` of
    t, x, y, p where these tell them, and (width, height).  `header_lines` come before the events;
    `unknown_header`: one that seems to name columns, but not all or not each, `has_y_first`: y
    before x."""

    width: int = 0
    separator: str | None = None
    has_decimal_comma: bool = False
    is_mixed: bool = False
    has_words: bool = False
    names: Sequence[str] = ()
    column_places: dict[str, int] | None = None
    unknown_header: str | None = None
    has_y_first: bool = False
    size: WidthHeight | None = None
    header_lines: int = 0


@contextmanager
def open_text(path: Path) -> Iterator[io.TextIOBase]:
    """Open a text file, or the one in a .gz or .zip, without its byte-order mark."""
    with _open_bytes(path) as file:
        start = file.peek(512)
        if start[:2] in (b"\xff\xfe", b"\xfe\xff"):
            raise ValueError("it is UTF-16; save it as UTF-8")
        if start[257:262] == b"ustar":
            raise ValueError("it is a .tar; unpack it first")
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
            parts = {n: PureWindowsPath(n) for n in names}  # between / or \
            names = [n for n in names if not parts[n].name.startswith("._")]  # of macOS
            named = [n for n in names if parts[n].stem.lower() == "events"]  # beside images.txt
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
    headers: list[tuple[str, list[str]]] = []  # lines that may name columns, and the names
    strange = y_first = None
    for number in range(MAX_HEADER_LINES):
        line = file.readline(MAX_LINE)
        if not line:
            if strange is not None:
                raise ValueError(f"no line of numbers t x y p in it, got {strange[:40]!r}")
            return TextLayout(size=size, header_lines=number)
        bare = line.strip()
        layout = None if bare.startswith(COMMENTS) else _read_row(bare, headers)
        if layout is not None:
            if y_first and layout.column_places is None:
                layout = layout._replace(unknown_header=y_first, has_y_first=True)
            return layout._replace(size=size, header_lines=number)
        here = _stated_size(bare)
        size = size or here
        title = bare.lstrip("#%/; ").encode("latin-1").decode(errors="replace")  # it may have µs
        names = _split_title(title)
        y_first = bare if _puts_y_first(title) else y_first
        is_named = find_columns_by_name(names) is not None
        is_strange = bare and not (bare.startswith(COMMENTS) or here or is_named)
        strange = bare if is_strange and strange is None else strange
        if is_named or is_strange or sum(map(bool, find_candidate_columns(names).values())) > 1:
            headers.append((bare, names))
    raise ValueError(f"no line of numbers t x y p among the first {MAX_HEADER_LINES}")


def _read_row(line: str, headers: list[tuple[str, list[str]]]) -> TextLayout | None:
    """Return how a line of an event is read, below `headers`; None for another line."""
    separator, has_decimal_comma = _find_separator(line)
    plain = line.translate(QUOTES)
    plain = plain.replace(",", ".") if has_decimal_comma else plain
    words = plain.split(separator)
    if not all(map(_is_value, plain.translate(TO_BLANKS).split())):
        return None
    names, places = _find_names(headers, len(words))
    is_mixed = not _is_event(words, places) and _has_mixed_separators(plain, separator)
    if is_mixed:
        separator, words = None, plain.translate(TO_BLANKS).split()
        names, places = _find_names(headers, len(words))
    if not _is_event(words, places):
        return None
    has_words = not all(is_number(word) for word in words if word.strip())
    how = separator, has_decimal_comma, is_mixed, has_words
    unknown, has_y_first = (None, False) if places else _find_unknown(headers, len(words))
    return TextLayout(len(words), *how, names, places, unknown, has_y_first)


def _is_event(words: list[str], places: dict[str, int] | None) -> bool:
    """Return whether these are values, four or more; others than those at `places` may be blank."""
    needed = range(len(words)) if places is None else places.values()
    return len(words) >= 4 and all(
        _is_value(word) or not (word.strip() or place in needed) for place, word in enumerate(words)
    )


def _find_names(
    headers: list[tuple[str, list[str]]], width: int
) -> tuple[list[str], dict[str, int] | None]:
    """Return the names of `width` columns, and the places of t, x, y, p by them; [] and None where
    none tell them."""
    found = [names for _, names in reversed(headers) if len(names) == width]
    for find in (find_columns_by_name, find_columns_by_part):
        for names in found:
            if places := find(names):
                return names, places
    return [], None


def _find_unknown(headers: list[tuple[str, list[str]]], width: int) -> tuple[str | None, bool]:
    """Return the last line that names `width` columns, but not all of t, x, y and p, and whether
    one names y before x: a list, or words that name t or p, too."""
    unknown, has_y_first = None, False
    for line, names in headers:
        if len(names) != width or _stated_size(line):
            continue
        found = find_candidate_columns(names)
        is_list = re.search(r"[,;|\t]", line) or found["t"] or found["p"]
        if is_list and found["x"] and found["y"] and min(found["y"]) < min(found["x"]):
            unknown, has_y_first = line, True
        elif is_list and not has_y_first:
            unknown = line
    return unknown, has_y_first


def _puts_y_first(text: str) -> bool:
    """Return whether a text lists t, x, y and p, y before x, as `each row is (t, y, x, p)` does."""
    text = text.lower()
    found = list(LISTED.finditer(text))
    orders = ["".join(LETTERS[one[1]] for one in four) for four in _lists_of_four(found, text)]
    orders += [word for word in re.findall(r"[^\W_]+", text) if len(word) == 4]  # tyxp
    return any({*order} == {*"txyp"} and order.index("y") < order.index("x") for order in orders)


def _lists_of_four(found: list[re.Match], text: str) -> Iterator[list[re.Match]]:
    for k in range(len(found) - 3):
        four = found[k : k + 4]
        gaps = [text[one.end() : other.start()] for one, other in pairwise(four)]
        if all(BETWEEN.fullmatch(gap) for gap in gaps):
            yield four


def _stated_size(line: str) -> WidthHeight | None:
    """Return (width, height) of `640 480`, `%geometry:640,480`, `t x@640 y@480 p` or `sensor size
    (h, w): 480 640`."""
    sides = dict(re.findall(r"\b([xy])@(\d+)", line))
    if len(sides) == 2:
        return int(sides["x"]), int(sides["y"])
    for match in GEOMETRY.finditer(line):
        before = line[max(0, match.start() - 12) : match.start()]
        if not (OF_OTHERS.search(before) or ARE_OTHERS.match(match[1])):
            return _in_order(match)
    alone = re.fullmatch(r"(\d+)[\s,;x]+(\d+)", line.lstrip("#% "))
    if alone is None or (line[0] in "#%" and min(int(alone[1]), int(alone[2])) < LEAST_SIDE):
        return None
    return int(alone[1]), int(alone[2])


def _in_order(match: re.Match) -> WidthHeight:
    """Return (width, height) of a GEOMETRY; height first where the labels before the numbers, those
    in brackets behind them or that of each number say so."""
    labelled = re.search(rf"{HEIGHT}[\s=:]*$", match[1], re.IGNORECASE) is not None
    labelled |= HEIGHT_FIRST.search(match[1]) is not None
    labelled |= HEIGHT_FIRST.fullmatch((match[4] or "").strip()) is not None
    return (int(match[3]), int(match[2])) if labelled else (int(match[2]), int(match[3]))


def _split_title(title: str) -> list[str]:
    """Return the names of columns in a line such as `t,x,y,p`, `columns: [t | y | x | p]`,
    `each line: t (us) x y p` or `time (float s), x, y, polarity (0=off)`."""
    title = re.sub(rf"\s+([\[(]{SECONDS}[\])])", r"\1", TITLE.sub("", title))
    behind = title.rpartition(":")[2].strip()
    bare = re.sub(r"[\[\](){}]", "", title).replace("|", ",").strip()
    for line in (behind, title, bare, re.sub(r"\([^)]*\)", "", title).strip()):
        names = [name.strip() for name in split_line(line, _find_separator(line)[0])]
        if find_columns_by_name(names):
            break
    return names


def _find_separator(line: str) -> tuple[str | None, bool]:
    """Return what separates values (None: blanks), and whether a comma is the decimal point."""
    if ";" in line.lstrip("; "):
        return ";", "," in line
    if len(line.split()) >= 4 and re.search(r"\d,\d", line):
        return None, True
    return ("," if "," in line else None), False


def _has_mixed_separators(line: str, separator: str | None) -> bool:
    """Return whether more than `separator` stands between or behind values."""
    values = line.split(separator)
    return separator is not None and (
        not values[-1].strip() or any(len(v.split()) > 1 for v in values)
    )


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
