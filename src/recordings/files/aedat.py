"""What must hold of an AEDAT4 file before its decoder, compiled code, sees it.

The decoder takes the memory that a length in the file asks for, unpacks without bound, and ends the
whole process where memory is not to be had or a description is no text or nested too deep.  After
the magic come the length of the header, the header (FlatBuffers: compression, place of the table of
packets, description) and the packets, each with its stream and its length, up to that table or the
end (iniVation's AEDAT4).  A packet is one LZ4 or Zstandard frame (LZ4 frame format 1.6, RFC 8878).
"""

import io
import struct
from collections.abc import Generator, Iterator
from pathlib import Path
from xml.etree import ElementTree

MAGIC = b"#!AER-DAT4.0\r\n"
LARGEST_PACKET = 2**28  # bytes, packed or not; ten thousand events have 160,000
DEEPEST = 50  # elements within each other in a description; cameras write five
LZ4, ZSTD, SKIPPED = b"\x04\x22\x4d\x18", b"\x28\xb5\x2f\xfd", b"\x2a\x4d\x18"
LZ4_RATIO, ZSTD_BLOCK = 255, 2**17  # at most: bytes out of one, bytes out of a block


def check_header(path: Path) -> None:
    """Raise ValueError, which names the file, for a header that cannot be read or is too deep, and
    for a table of more than LARGEST_PACKET bytes: the decoder reads both when it opens the file.
    """
    _, table, description = _header(path)
    if 0 <= table < path.stat().st_size:
        with path.open("rb") as file:
            file.seek(table)
            _check_size(path, file.read(LARGEST_PACKET + 1))
    depth = 0
    try:
        for event, _ in ElementTree.iterparse(io.StringIO(description), ("start", "end")):
            depth += 1 if event == "start" else -1
            if depth > DEEPEST:
                raise ValueError(f"{path}: its description is nested beyond {DEEPEST} levels")
    except ElementTree.ParseError as error:
        raise ValueError(f"{path}: its description cannot be read: {error}") from error


def check_packets(path: Path) -> None:
    """Raise ValueError, which names the file, for a packet longer than it or than LARGEST_PACKET,
    as it lies there or unpacked.
    """
    whole, (start, table, _) = path.stat().st_size, _header(path)
    with path.open("rb") as file:
        file.seek(start)
        while file.tell() != table and len(prefix := file.read(8)) == 8:
            _, length = struct.unpack("<II", prefix)
            if file.tell() + length > whole:
                raise ValueError(f"{path}: a packet of {length} bytes is longer than the file")
            _check_size(path, file.read(min(length, LARGEST_PACKET + 1)))


def _check_size(path: Path, packet: bytes) -> None:
    if max(len(packet), _unpacked(packet)) > LARGEST_PACKET:
        raise ValueError(f"{path}: a packet has more than {LARGEST_PACKET} bytes")


def _header(path: Path) -> tuple[int, int, str]:
    """Return where the packets begin and end (-1: with the file), and the description."""
    with path.open("rb") as file:
        start = file.read(len(MAGIC) + 4)
        length = int.from_bytes(start[len(MAGIC) :], "little")
        if len(start) + length > path.stat().st_size:
            raise ValueError(f"{path}: a header of {length} bytes is longer than the file")
        header = file.read(length)
    try:
        return len(start) + length, *_fields(header)
    except (struct.error, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: its header cannot be read: {error}") from error


def _fields(header: bytes) -> tuple[int, str]:
    """Return the place of the table and the description."""
    (root,) = struct.unpack_from("<I", header)
    places = root - struct.unpack_from("<i", header, root)[0]
    if places < 0:
        raise struct.error("its fields lie before it")
    compression, table, description = struct.unpack_from("<HHH", header, places + 4)
    struct.unpack_from("<i", header, root + compression)
    text = root + description + struct.unpack_from("<I", header, root + description)[0]
    (size,) = struct.unpack_from("<I", header, text)
    (words,) = struct.unpack_from(f"{size}s", header, text + 4)
    return struct.unpack_from("<q", header, root + table)[0] if table else -1, words.decode()


def _unpacked(packet: bytes) -> int:
    """Return how many bytes a packet gives at most; 0 where it is not packed."""
    return sum((_lz4 if packet.startswith(LZ4) else _zstd)(packet))


def _lz4(packet: bytes) -> Iterator[int]:
    """Yield how many bytes each block gives at most, up to the end or where the packet is cut."""
    if len(packet) < 7:
        return
    flags, largest = packet[4], 2 ** (8 + 2 * (packet[5] >> 4 & 7))
    at = 7 + 8 * (flags >> 3 & 1) + 4 * (flags & 1)
    while head := int.from_bytes(packet[at : at + 4], "little"):
        size = head & 0x7FFFFFFF
        yield size if head >> 31 else min(LZ4_RATIO * size, largest)
        at += 4 + size + 4 * (flags >> 4 & 1)


def _zstd(packet: bytes) -> Iterator[int]:
    """Yield the same for one frame after the other."""
    at = 0
    while len(magic := packet[at : at + 4]) == 4:
        if magic[1:] == SKIPPED and magic[0] >> 4 == 5:
            at += 8 + int.from_bytes(packet[at + 4 : at + 8], "little")
        elif magic == ZSTD:
            at = yield from _zstd_frame(packet, at)
        else:
            if magic[1:] == ZSTD[1:]:
                yield LARGEST_PACKET + 1  # a format from before 1.0, which nobody writes
            return


def _zstd_frame(packet: bytes, at: int) -> Generator[int, None, int]:
    """Yield the same for the frame that begins `at`; returns where it ends."""
    flags = int.from_bytes(packet[at + 4 : at + 5], "little")
    single, last = flags >> 5 & 1, 0
    at += 6 - single + (0, 1, 2, 4)[flags & 3] + (single, 2, 4, 8)[flags >> 6]
    while not last and len(start := packet[at : at + 3]) == 3:
        head = int.from_bytes(start, "little")
        last, kind, size = head & 1, head >> 1 & 3, head >> 3
        yield size if kind < 2 else ZSTD_BLOCK
        at += 4 if kind == 1 else 3 + size
    return at + 4 * (flags >> 2 & 1)
