"""Prophesee's RAW (EVT2, EVT2.1, EVT3) and DAT files.

Both begin with lines of text, `% key value` (Metavision's pages "RAW file format" and "DAT file
format"), which come in any order.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.blocks import read_whole_words
from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.event_file import (
    PIECE_EVENTS,
    RAW_FORMATS,
    EventFile,
    RawEvents,
    ReadOptions,
    WidthHeight,
)
from src.recordings.files.evt_decoder import (
    MOST_EVENTS,
    WORD_BYTES,
    WORD_ORDERS,
    EvtDecoder,
    find_shown_kind,
)

SENSORS = {
    "gen3": (640, 480), "gen4": (1280, 720), "imx636": (1280, 720), "imx646": (1280, 720),
    "genx320": (320, 320),
}  # fmt: skip
HEADER = re.compile(rb"(?:% (?!end\s)[\t\r\x20-\x7e\x80-\xff]*\n)*(?:% end[\t\r ]*\n)?")
ATIS, ATIS_BITS = (304, 240), (9, 8)  # px, and bits of x and y in DAT of versions 0 and 1
DAT_PIXELS = (0, 12)  # types of DAT whose events lie in pixels
DAT_TRIGGER = 14


class PropheseeFile(EventFile):
    """A `.raw` or `.dat` file; times are microseconds.

    `options.format` is what a RAW file holds that does not say it.  Words of EVT2 in a file that
    says EVT3, or the other way round, are read as what they are, with a note.  Raises ValueError
    for one that says nothing without `format` or says another, and for other formats.
    """

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with path.open("rb") as file:
            found = HEADER.match(file.read(1 << 16))
        text = found.group().decode("latin-1").lower() if found else ""
        self._start = len(text)
        self._lines = dict(re.findall(r"^% (\w+)[ :=]*([^\r\n]*?)\s*$", text, re.MULTILINE))
        start_us = self._lines.get("t0", "")  # what faery takes off all times
        self._start_us = int(start_us) if re.fullmatch(r"\d{1,18}", start_us) else 0
        self.size = self._read_size(text)
        self._format = None
        if path.suffix.lower() != ".dat":
            self._format = self._read_format(options.format)
        elif "version" not in self._lines and self._has_words_of_atis():
            self.size, self._lines["version"] = self.size or ATIS, "0"

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of a file that ends within a word and of events before the first
        time; raises ValueError for a file of nothing but triggers."""
        for events in self._dat_pieces() if self._format is None else self._raw_pieces():
            if len(events.t):
                yield events._replace(t=events.t + self._start_us) if self._start_us else events

    def _read_size(self, text: str) -> WidthHeight | None:
        geometry = re.match(r"(\d{1,9}) *x *(\d{1,9})", self._lines.get("geometry", ""))
        if geometry:
            return int(geometry[1]), int(geometry[2])
        stated = dict(re.findall(r"(width|height)=(\d+)", self._lines.get("format", "")))
        stated = self._lines | stated
        width, height = (re.match(r"\d{1,9}", stated.get(side, "")) for side in ("width", "height"))
        if width and height:
            return int(width.group()), int(height.group())
        name = re.search("|".join(SENSORS), text)
        return SENSORS[name.group()] if name else None

    def _read_format(self, stated: str | None) -> str:
        line = self._lines.get("format", "").split(";")[0].strip()
        line = f"evt{self._lines['evt']}" if "evt" in self._lines else line
        said = line.replace(".0", "").replace(".", "")
        if not said and not stated:
            raise ValueError(
                f"{self.path}: no `% evt` or `% format` line in its header; format must be evt2, "
                "evt21 or evt3, got null"
            )
        if said and said not in RAW_FORMATS:
            raise ValueError(f"{self.path}: {line.upper()} is not read, but EVT2, EVT2.1 and EVT3")
        if said and stated and stated != said:
            raise ValueError(f"{self.path}: format must be {said} as its header, got {stated}")
        return self._find_kind_of_words(said or str(stated))

    def _find_kind_of_words(self, said: str) -> str:
        with self.path.open("rb") as file:
            file.seek(self._start)
            kind = find_shown_kind(file.read(1 << 16), said)
        if kind != said:
            said, shown = said.upper(), kind.upper()
            self.notes = (f"{self.path}: states {said}, its words are {shown}: read as {shown}",)
        return kind

    def _raw_pieces(self) -> Iterator[RawEvents]:
        kind, found = str(self._format), 0
        order = re.search(r"endianness=(\w+)", self._lines.get("format", ""))
        decoder = EvtDecoder(kind, order[1] if order and order[1] in WORD_ORDERS else None)
        words = PIECE_EVENTS // max(1, MOST_EVENTS[kind] // 2)
        at, word_bytes = self._start, WORD_BYTES[kind]
        for block in read_whole_words(self.path, at, word_bytes, words):
            sound = decoder.count_valid_words(block) * word_bytes
            events = decoder.decode(block[:sound])
            at, found = at + sound, found + len(events.t)
            yield events
            if sound < len(block):
                left = f"its last {self.path.stat().st_size - at} bytes are left out"
                line = f"{self.path}: its words are no {kind.upper()} from byte {at} on: {left}"
                warnings.warn(f"{line}; is a byte lost, or format= another?", stacklevel=3)
                break
        if not found and decoder.triggers:
            raise ValueError(f"{self.path}: holds no events, only {decoder.triggers} triggers")
        if decoder.lost > found:
            raise ValueError(
                f"{self.path}: {decoder.lost} of {found + decoder.lost} events come before the "
                f"first time; is it {kind.upper()}, and whole?"
            )
        if decoder.lost:
            warnings.warn(
                f"{self.path}: {decoder.lost} events before the first time, dropped", stacklevel=3
            )

    def _has_words_of_atis(self) -> bool:
        """Return whether the first words have no more bits than those of the first ATIS."""
        with self.path.open("rb") as file:
            file.seek(self._start + 2)
            block = file.read(1 << 16)
        words = np.frombuffer(block[: len(block) // 8 * 8], "<u4")[1::2]
        return len(words) > 0 and not (words >> (sum(ATIS_BITS) + 1)).any()

    def _dat_pieces(self) -> Iterator[RawEvents]:
        with self.path.open("rb") as file:
            file.seek(self._start)
            head = file.read(2)
        if not head and self._start:
            return  # a recording without events
        if not self._start:
            raise ValueError(f"{self.path}: does not begin with `% ` as a DAT file does")
        if head[0] == DAT_TRIGGER:
            raise ValueError(f"{self.path}: holds no events, only triggers (DAT of type 14)")
        if head[0] not in DAT_PIXELS or head[1:] != b"\10":
            raise ValueError(f"{self.path}: DAT of type {head.hex(' ')} is not read, but 0 and 12")
        x_bits, y_bits = ATIS_BITS if self._lines.get("version") in ("0", "1") else (14, 14)
        clock = TimestampUnwrapper()
        for block in read_whole_words(self.path, self._start + 2, 8):
            t, word = np.frombuffer(block, "<u4").reshape(-1, 2).T
            x, y = word & (1 << x_bits) - 1, word >> x_bits & (1 << y_bits) - 1
            on = word >> (x_bits + y_bits) & 15
            yield RawEvents(clock.unwrap(t), x.astype(np.uint16), y.astype(np.uint16), on > 0)
