"""jAER's AEDAT 1.0 and 2.0 and cAER's AEDAT 3.1 (.aedat; iniVation's page "AEDAT file formats").

1.0 and 2.0: lines that begin with `#`, then of each event its address (16 or 32 bits) and its time
in microseconds (32 bits), big endian.  An address of a DVS128 has, from the lowest bit, 1 bit OFF,
7 of x, 7 of y, 1 of a trigger; one of a DAVIS 10 of a sample, 1 of a trigger, 1 ON, 10 of x, 9 of
y, 1 of a sample of its frames or its motion.  Their x counts from the right and y from below: both
are turned, as jAER shows them.  3.1: packets behind 28 bytes that say what they hold, little
endian; x and y from the upper left.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.aedat3_packets import iter_polarity
from src.recordings.files.clocks import TimestampUnwrapper, merge_small_pieces
from src.recordings.files.event_file import PIECE_EVENTS, EventFile, RawEvents, ReadOptions
from src.recordings.files.streams import EventStream, choose_stream

LARGEST_HEADER = 2**24  # bytes; jAER's settings are in it
LINE = re.compile(rb"#[^\n\x00-\x08\x0e-\x1f]*\n")
LAST_LINE = re.compile(rb"#(End Of ASCII|!END-HEADER)", re.IGNORECASE)
DVS128 = (128, 128)
SENSORS = {
    "dvs128": DVS128, "davis208": (208, 192), "davis240": (240, 180), "sbret10": (240, 180),
    "davis346": (346, 260), "davis640": (640, 480),
}  # fmt: skip
DAVIS_OTHERS = 1 << 31 | 1 << 10  # bits of what is no event of a pixel


class Aedat2File(EventFile):
    """An `.aedat` file of version 1.0, 2.0 or 3.1; times are microseconds.

    Which camera it was is read in its header, else told by its addresses, which `notes` says.
    `options.stream` is the place or the name of one of several cameras in a file of 3.1.  Raises
    ValueError for a file of another version.
    """

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        lines, self._start = _read_lines(path)
        version = re.match(r"#!aer-dat(\d\.\d)", lines)
        self._version = version[1] if version else ""
        if self._version not in ("1.0", "2.0", "3.1"):
            found = f"AEDAT {self._version}" if version else "a file without `#!AER-DAT`"
            raise ValueError(f"{path}: must be AEDAT 1.0, 2.0 or 3.1, is {found}")
        if self._version == "3.1":
            sources = re.findall(r"#source (\d{1,4}): *([\w-]*)", lines) or [("0", "camera")]
            streams = [EventStream(int(number), name, _find_size(name)) for number, name in sources]
            chosen, self.notes = choose_stream(path, streams, options.stream)
            self._source, self.size = chosen.id, chosen.size
            return
        named = re.findall(r"(?:aechip|hardwareinterface)[^\n]*", lines)
        self.size = _find_size(" ".join(sorted(named))) or _find_size(lines)
        if self.size is None:
            self.size = self._guess_size()
            self.notes = (f"{path}: names no camera, its addresses fit {self.size}",)

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of a file that ends within one; raises ValueError for a file of
        nothing but frames, motion or triggers, and for packets that cannot be."""
        if self._version == "3.1":
            yield from merge_small_pieces(iter_polarity(self.path, self._start, self._source))
            return
        found, words, clock = 0, 0, TimestampUnwrapper()
        for address, t in self._words():
            on, x, y, pixel = self._split(address)
            found, words = found + int(pixel.sum()), words + len(pixel)
            yield RawEvents(*(part[pixel] for part in (clock.unwrap(t), x, y, on)))
        if words and not found:
            raise ValueError(f"{self.path}: holds no events, only {words} words of other kinds")

    def _words(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield addresses and times, (n,) uint32 each."""
        kind = np.dtype([("address", ">u2" if self._version == "1.0" else ">u4"), ("t", ">u4")])
        with self.path.open("rb") as file:
            file.seek(self._start)
            while block := file.read(kind.itemsize * PIECE_EVENTS):
                count, cut = divmod(len(block), kind.itemsize)
                if cut:
                    warnings.warn(
                        f"{self.path}: ends within an event, it is truncated", stacklevel=3
                    )
                words = np.frombuffer(block, kind, count)
                yield words["address"].astype(np.uint32), words["t"].astype(np.uint32)

    def _split(self, address: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return ON, x and y as jAER shows them, and which are pixels; (n,) each."""
        width, height = self.size or DVS128
        if self.size == DVS128:
            on, x, y, pixel = ~address & 1, address >> 1 & 127, address >> 8 & 127, address < 2**15
        else:
            on, x, y = _split_davis(address)
            pixel = address & DAVIS_OTHERS == 0
        return on, width - 1 - x.astype(np.int32), height - 1 - y.astype(np.int32), pixel

    def _guess_size(self) -> tuple[int, int] | None:
        """Return the smallest sensor that holds all addresses; None where there are none."""
        largest = np.zeros(3, np.int64)
        for address, _ in self._words():
            pixels = address[address & DAVIS_OTHERS == 0]
            if len(pixels):
                sides = (part.max() for part in _split_davis(pixels)[1:])
                largest = np.maximum(largest, [address.max(), *sides])
        if largest[0] < 2**16:
            return DVS128 if largest[0] else None
        fitting = (SENSORS[name] for name in ("davis240", "davis346", "davis640"))
        return next((size for size in fitting if (largest[1:] < size).all()), SENSORS["davis640"])


def _split_davis(address: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ON, x and y of a DAVIS as its addresses count them."""
    return address >> 11 & 1, address >> 12 & 1023, address >> 22 & 511


def _find_size(text: str) -> tuple[int, int] | None:
    name = re.search("|".join(SENSORS), text)
    return SENSORS[name.group()] if name else None


def _read_lines(path: Path) -> tuple[str, int]:
    """Return the lines at the start that begin with `#`, in small letters, and where they end."""
    at = 0
    with path.open("rb") as file:
        content = file.read(LARGEST_HEADER)
    while line := LINE.match(content, at):
        at = line.end()
        if LAST_LINE.match(line.group()):
            break
    return content[:at].decode("latin-1").lower(), at
