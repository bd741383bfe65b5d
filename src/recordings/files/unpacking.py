"""Packed content to as many bytes as are allowed: a small file can claim any amount of memory."""

import bz2
from typing import Any

from backports.zstd import ZstdDecompressor
from lz4.frame import LZ4FrameDecompressor

LARGEST_PACKET = 2**28  # bytes; ten thousand events have 160,000
STEP = 2**20  # bytes unpacked at a time
UNPACKERS: dict[str, Any] = {
    "lz4": LZ4FrameDecompressor, "zstd": ZstdDecompressor, "bz2": bz2.BZ2Decompressor
}  # fmt: skip


def decompress(content: bytes, kind: str) -> bytes:
    """Return what one frame of lz4, zstd or bz2 holds.

    Raises ValueError for more than LARGEST_PACKET bytes; errors of the libraries go through.
    """
    unpacker, size, parts = UNPACKERS[kind](), 0, []
    while not unpacker.eof and (content or not unpacker.needs_input):
        parts.append(unpacker.decompress(content, STEP))
        content, size = b"", size + len(parts[-1])
        if size > LARGEST_PACKET:
            raise ValueError(f"what is packed has more than {LARGEST_PACKET} bytes")
    return b"".join(parts)
