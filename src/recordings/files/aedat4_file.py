"""iniVation's AEDAT4: packets of one or several streams, of which those of events are read.

After the magic come the length of the header, the header (FlatBuffers: compression, place of the
table of packets, description in XML) and the packets, each with its stream and its length, up to
that table or the end (iniVation's page "AEDAT 4.0").  A packet is one LZ4 or Zstandard frame or
bare; in it a FlatBuffers table holds the events, 16 bytes each.  The memory that a file asks for is
bounded before it is given.
"""

import io
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np

from src.recordings.files.blocks import merge_small_pieces
from src.recordings.files.event_file import (
    EventFile,
    EventStream,
    RawEvents,
    ReadOptions,
    choose_stream,
    name_file_in_errors,
)
from src.recordings.files.unpacking import LARGEST_PACKET, decompress

MAGIC = b"#!AER-DAT4.0\r\n"
DEEPEST = 50  # elements within each other in a description; cameras write five
PACKINGS = {1: "lz4", 2: "lz4", 3: "zstd", 4: "zstd"}  # of the header; 0: none
STORED = np.dtype(
    {"names": list("txyp"), "formats": ["<i8", "<u2", "<u2", "u1"], "offsets": [0, 8, 10, 12],
     "itemsize": 16}
)  # fmt: skip
KINDS = {"EVTS": "events", "FRME": "frames", "IMUS": "inertial data", "TRIG": "triggers"}


class Aedat4Header(NamedTuple):
    """What an AEDAT4 file says of itself; its packets lie from `start` to `end` (-1: its end)."""

    compression: int
    start: int
    end: int
    description: str


class Aedat4File(EventFile):
    """An `.aedat4` file; times are microseconds.

    `options.stream` is the place or the camera's name of one of several event streams, the first by
    default.  Raises ValueError for a file that cannot be read or has no such stream.
    """

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        self._header = _read_header(path)
        streams = _read_streams(path, self._header.description)
        events = [stream for kind, stream in streams if kind == "EVTS"]
        if not events:
            others = ", ".join(KINDS.get(kind, kind) for kind, _ in streams) or "nothing"
            raise ValueError(f"{path}: holds no stream of events, only {others}")
        chosen, self.notes = choose_stream(path, events, options.stream)
        self._id, self.size = chosen.id, chosen.size

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events of all whole packets; warns of a file that ends within one.

        Raises ValueError for a packet that cannot be unpacked, and where only other streams of the
        file hold anything.
        """
        found = 0
        for piece in merge_small_pieces(self._events()):
            found += len(piece.t)
            yield piece
        if not found and (others := sum(stream != self._id for stream, _ in self._packets())):
            raise ValueError(f"{self.path}: holds no events, only {others} packets of other kinds")

    def _events(self) -> Iterator[RawEvents]:
        for stream, packet in self._packets():
            if stream == self._id:
                with name_file_in_errors(self.path, "cannot be decoded"):
                    packing = PACKINGS.get(self._header.compression)
                    events = _read_events(decompress(packet, packing) if packing else packet)
                yield RawEvents(*(events[name] for name in "txyp"))

    def _packets(self) -> Iterator[tuple[int, bytes]]:
        """Yield the stream of each whole packet, and its content, b"" of another stream.

        Warns of a file that ends within a packet; raises ValueError where that is the first.
        """
        whole, end, count = self.path.stat().st_size, self._header.end, 0
        with self.path.open("rb") as file:
            file.seek(self._header.start)
            while file.tell() != end and len(prefix := file.read(8)) == 8:
                stream, length = struct.unpack("<II", prefix)
                left = whole - file.tell()
                if length > LARGEST_PACKET:
                    far = "longer than the file" if length > left else f"over {LARGEST_PACKET}"
                    raise ValueError(f"{self.path}: a packet of {length} bytes is {far}")
                if length > left:
                    break
                yield stream, file.read(length) if stream == self._id else b""
                file.seek(whole - left + length)
                count += 1
            if file.tell() != (whole if end < 0 else end):
                if not count:
                    raise ValueError(f"{self.path}: ends within its first packet")
                warnings.warn(f"{self.path}: ends within a packet, it is truncated", stacklevel=2)


def _read_events(content: bytes) -> np.ndarray:
    """Return the events (n,) STORED of a packet: the vector that is its table's first field."""
    (root,) = struct.unpack_from("<I", content, 4)  # behind the size of all
    table = _table(content, root + 4)
    if not table:
        return np.empty(0, STORED)
    vector = table[0] + struct.unpack_from("<I", content, table[0])[0]
    return np.frombuffer(content, STORED, struct.unpack_from("<I", content, vector)[0], vector + 4)


def _table(content: bytes, root: int) -> list[int]:
    """Return where the fields of the FlatBuffers table at `root` lie, 0 for one left out; raises
    struct.error where they lie outside."""
    places = root - struct.unpack_from("<i", content, root)[0]
    if places < 0:
        raise struct.error("its fields lie before it")
    count = (struct.unpack_from("<H", content, places)[0] - 4) // 2
    fields = struct.unpack_from(f"<{max(count, 0)}H", content, places + 4)
    return [root + field if field else 0 for field in fields]


def _read_header(path: Path) -> Aedat4Header:
    with path.open("rb") as file:
        start = file.read(len(MAGIC) + 4)
        length = int.from_bytes(start[len(MAGIC) :], "little")
        if not start.startswith(MAGIC):
            raise ValueError(f"{path}: does not begin as an AEDAT4 file")
        if len(start) + length > path.stat().st_size:
            raise ValueError(f"{path}: a header of {length} bytes is longer than the file")
        header = file.read(length)
    with name_file_in_errors(path, "its header cannot be read"):
        return _parse_header(header, len(start) + length)


def _parse_header(header: bytes, start: int) -> Aedat4Header:
    """Return what a header says, behind which the packets begin at byte `start`."""

    def read(kind: str, at: int) -> int:
        return struct.unpack_from(kind, header, at)[0]

    compression, end, text = _table(header, read("<I", 0))[:3]
    text += read("<I", text)
    (words,) = struct.unpack_from(f"{read('<I', text)}s", header, text + 4)
    return Aedat4Header(
        read("<i", compression) if compression else 0,
        start,
        read("<q", end) if end else -1,
        words.decode(),
    )


def _read_streams(path: Path, description: str) -> list[tuple[str, EventStream]]:
    """Return the kind of each stream (EVTS, FRME, ...) and the stream."""
    depth, found = 0, []
    with name_file_in_errors(path, "its description cannot be read"):
        for event, node in ElementTree.iterparse(io.StringIO(description), ("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > DEEPEST:
                raise ValueError(f"{path}: its description is nested beyond {DEEPEST} levels")
            kind = node.findtext("attr[@key='typeIdentifier']") if event == "end" else None
            if kind and node.get("name", "x")[:9].isdecimal():
                found.append((kind, _read_stream(node)))
    return found


def _read_stream(node: ElementTree.Element) -> EventStream:
    info = {part.get("key"): part.text or "" for part in node.iterfind("node[@name='info']/attr")}
    sides = [info.get(key, "") for key in ("sizeX", "sizeY")]
    known = all(side.isdecimal() and len(side) < 10 for side in sides)
    number = node.get("name", "")[:9]
    size = (int(sides[0]), int(sides[1])) if known else None
    return EventStream(int(number), info.get("source") or f"stream {number}", size)
