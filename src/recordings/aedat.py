"""What must hold of an AEDAT4 file before its decoder, compiled code, sees it.

The decoder takes the memory that a length in the file asks for and ends the whole process where
that is not to be had, or where the description is no text.  After the magic come the length of the
header, the header (FlatBuffers: compression, place of the table of packets, description) and the
packets, each with its stream and its length, up to that table or the end (iniVation's AEDAT4).
"""

import struct
from pathlib import Path
from typing import BinaryIO

MAGIC = b"#!AER-DAT4.0\r\n"


def check(path: Path) -> None:
    """Raise ValueError, which names the file, for a header that is none and lengths beyond it."""
    with path.open("rb") as file:
        start = file.read(len(MAGIC) + 4)
        length = int.from_bytes(start[len(MAGIC) :], "little")
        whole = path.stat().st_size
        if len(start) + length > whole:
            raise ValueError(f"{path}: a header of {length} bytes is longer than the file")
        try:
            end = _end(file.read(length))
        except (struct.error, UnicodeDecodeError) as error:
            raise ValueError(f"{path}: its header cannot be read: {error}") from error
        longest = _longest(file, end if 0 < end < whole else whole)
    if longest > whole:
        raise ValueError(f"{path}: a packet of {longest} bytes is longer than the file")


def _end(header: bytes) -> int:
    """Return where the packets end, as the header has it; read its description, too."""
    (table,) = struct.unpack_from("<I", header)
    places = table - struct.unpack_from("<i", header, table)[0]
    end, description = struct.unpack_from("<HH", header, places + 6)
    text = table + description + struct.unpack_from("<I", header, table + description)[0]
    (size,) = struct.unpack_from("<I", header, text)
    header[text + 4 : text + 4 + size].decode()
    return struct.unpack_from("<q", header, table + end)[0] if end else -1


def _longest(file: BinaryIO, end: int) -> int:
    """Return the largest length that a packet before `end` claims."""
    longest = 0
    while file.tell() + 8 <= end:
        _, length = struct.unpack("<II", file.read(8))
        longest = max(longest, length)
        file.seek(length, 1)
    return longest
