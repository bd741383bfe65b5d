"""jAER's AEDAT 1.0 and 2.0 and cAER's AEDAT 3.1 (.aedat; iniVation's page "AEDAT file formats").

1.0 and 2.0: lines that begin with `#`, then of each event its address (16 or 32 bits) and its time
in microseconds (32 bits), big endian.  An address of a DVS128 has, from the lowest bit, 1 bit OFF,
7 of x, 7 of y, 1 of a trigger; one of a DAVIS 10 of a sample, 1 of a trigger, 1 ON, 10 of x, 9 of
y, 1 of a sample of its frames or its motion; one of a DVS640 1 ON, 10 of x, 10 of y.  Their x
counts from the right and y from below: both are turned, as jAER shows them.  3.1: packets behind 28
bytes that say what they hold, little endian; x and y from the upper left.
"""

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.files.blocks import merge_small_pieces, read_whole_words
from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.event_file import (
    EventFile,
    EventStream,
    RawEvents,
    ReadOptions,
    WidthHeight,
    choose_stream,
)
from src.recordings.files.unpacking import LARGEST_PACKET

LARGEST_HEADER = 2**24  # bytes; jAER's settings are in it
LINE = re.compile(rb"#[^\n\x00-\x08\x0e-\x1f]*\n")
LAST_LINE = re.compile(rb"#(End Of ASCII|!END-HEADER)", re.IGNORECASE)
SENSORS = {
    "dvs128": (128, 128), "dvs640": (640, 480), "davis208": (208, 192), "davis240": (240, 180),
    "sbret10": (240, 180), "davis346": (346, 260), "davis640": (640, 480),
}  # fmt: skip
DVS640_BITS = 21  # a DAVIS has y above
DAVIS_OTHERS = 1 << 31 | 1 << 10  # bits of what is no event of a pixel
PACKET_HEADER = np.dtype(
    [("kind", "<i2"), ("source", "<i2"), ("bytes", "<i4"), ("time_at", "<i4"), ("rounds", "<i4"),
     ("room", "<i4"), ("count", "<i4"), ("valid", "<i4")]
)  # fmt: skip
POLARITY = 1  # kind of a packet of events


class Aedat1To3File(EventFile):
    """An `.aedat` file of version 1.0, 2.0 or 3.1; times are microseconds.

    Which camera it was is read in its header, else told by its addresses, which `notes` says; the
    user may state the sides of a larger DAVIS, from which places are then counted.
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
            streams = [
                EventStream(int(number), name, SENSORS.get(_find_camera(name)))
                for number, name in sources
            ]
            chosen, self.notes = choose_stream(path, streams, options.stream)
            self._source, self.size = chosen.id, chosen.size
            return
        named = re.findall(r"(?:aechip|hardwareinterface)[^\n]*", lines)
        camera = _find_camera(" ".join(sorted(named))) or _find_camera(lines)
        self._is_guess, self._camera = not camera, camera or self._guess_camera()
        self.size = SENSORS.get(self._camera)
        self.use_sensor_size(None)

    def use_sensor_size(self, size: WidthHeight | None) -> None:
        if self._version == "3.1" or not (self._is_guess and self._camera):
            return
        guess = SENSORS[self._camera]
        davises = [SENSORS[name] for name in SENSORS if name.startswith("davis")]
        is_larger = guess in davises and size in davises and size > guess
        self.size = size if is_larger else guess
        hint = "; if it is another, give sensor_size=[height,width]" if size is None else ""
        fitting = f"its addresses fit a sensor of {guess[0]}x{guess[1]}"
        self.notes = (f"{self.path}: names no camera, {fitting}{hint}",)

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of a file that ends within one; raises ValueError for a file of
        nothing but frames, motion or triggers, and for packets that cannot be."""
        if self._version == "3.1":
            yield from merge_small_pieces(_iter_polarity(self.path, self._start, self._source))
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
        for block in read_whole_words(self.path, self._start, kind.itemsize):
            words = np.frombuffer(block, kind)
            yield words["address"].astype(np.uint32), words["t"].astype(np.uint32)

    def _split(self, address: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return ON, x and y as jAER shows them, and which are pixels; (n,) each."""
        if self._camera == "dvs128":
            on, x, y, pixel = ~address & 1, address >> 1 & 127, address >> 8 & 127, address < 2**15
        elif self._camera == "dvs640":
            on, x, y = address & 1, address >> 1 & 1023, address >> 11 & 1023
            pixel = address < 1 << DVS640_BITS
        else:
            on, x, y = _split_davis(address)
            pixel = address & DAVIS_OTHERS == 0
        width, height = self.size or (0, 0)
        return on, width - 1 - x.astype(np.int32), height - 1 - y.astype(np.int32), pixel

    def _guess_camera(self) -> str:
        """Return the smallest camera that holds all addresses; "" where there are none."""
        largest = np.zeros(3, np.int64)
        with warnings.catch_warnings(action="ignore"):  # said when the events are read
            for address, _ in self._words():
                pixels = address[address & DAVIS_OTHERS == 0]
                if len(pixels):
                    sides = (part.max() for part in _split_davis(pixels)[1:])
                    largest = np.maximum(largest, [address.max(), *sides])
        if largest[0] < 2**16:
            return "dvs128" if largest[0] else ""
        if not largest[2]:
            return "dvs640"
        fitting = ("davis240", "davis346", "davis640")
        return next((name for name in fitting if (largest[1:] < SENSORS[name]).all()), fitting[-1])


def _split_davis(address: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ON, x and y of a DAVIS as its addresses count them."""
    return address >> 11 & 1, address >> 12 & 1023, address >> 22 & 511


def _find_camera(text: str) -> str:
    """Return which of SENSORS a text names, "" for none."""
    name = re.search("|".join(SENSORS), text)
    return name.group() if name else ""


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


def _iter_polarity(path: Path, start: int, source: int) -> Iterator[RawEvents]:
    """Yield the valid events of a camera, packet by packet from byte `start`, times in us.

    An event has 32 bits (from the lowest 1 valid, 1 ON, 15 of y, 15 of x) and its time.  Warns of a
    file that ends within a packet.  Raises ValueError for a packet that cannot be, and where only
    packets of other kinds come.
    """
    found, others, left = 0, 0, path.stat().st_size - start
    with path.open("rb") as file:
        file.seek(start)
        while left >= PACKET_HEADER.itemsize:
            head = np.frombuffer(file.read(PACKET_HEADER.itemsize), PACKET_HEADER)[0]
            size = _packet_bytes(path, head)
            left -= PACKET_HEADER.itemsize + size
            if left < 0:
                break
            content = file.read(size)
            if head["kind"] == POLARITY and head["source"] == source:
                found += int(head["count"])
                yield _polarity_events(content, int(head["rounds"]))
            else:
                others += 1
    if left:
        warnings.warn(f"{path}: ends within a packet, it is truncated", stacklevel=3)
    if others and not found:
        raise ValueError(f"{path}: holds no events, only {others} packets of other kinds")


def _packet_bytes(path: Path, head: np.void) -> int:
    size = int(head["bytes"]) * int(head["count"])
    least = 8 if head["kind"] == POLARITY else 0
    if head["bytes"] < least or head["count"] < 0 or not 0 <= size <= LARGEST_PACKET:
        raise ValueError(
            f"{path}: a packet of {head['count']} events of {head['bytes']} bytes cannot be"
        )
    return size


def _polarity_events(content: bytes, rounds: int) -> RawEvents:
    words = np.frombuffer(content, "<u4").reshape(-1, 2)
    data, t = words[words[:, 0] & 1 == 1].T
    x, y = (data >> 17).astype(np.uint16), (data >> 2 & 0x7FFF).astype(np.uint16)
    return RawEvents(t.astype(np.int64) + (rounds << 31), x, y, data >> 1 & 1)
