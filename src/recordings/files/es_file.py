"""Event Stream files (.es, github.com/neuromorphicsystems/event_stream), by faery."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import faery
import numpy as np

from src.recordings.engines.es_bytes import count_missing_bytes
from src.recordings.files.clocks import read_whole_words
from src.recordings.files.event_file import EventFile, RawEvents, ReadOptions, name_file_in_errors

HEADER_BYTES, KIND_AT, ATIS = 20, 15, 2
LONE = {True: 0xFC, False: 0xFE}  # of ATIS or DVS: bytes from it on are no event's first


class EsFile(EventFile):
    """An `.es` file of DVS or ATIS events; times are microseconds."""

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with name_file_in_errors(path, "cannot be decoded"):
            self._decoder = faery.events_stream_from_file(path, file_type="es")
            self.size = self._decoder.dimensions()

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of a file that ends within one; raises ValueError for one that
        cannot be decoded."""
        with name_file_in_errors(self.path, "cannot be decoded"):
            for events in self._decoder:
                yield RawEvents(events["t"].view("i8"), events["x"], events["y"], events["on"])
        if _ends_within_event(self.path):
            warnings.warn(f"{self.path}: ends within an event, it is truncated", stacklevel=2)


def _ends_within_event(path: Path) -> bool:
    with path.open("rb") as file:
        is_atis = file.read(HEADER_BYTES)[KIND_AT] == ATIS
    missing = 0
    for block in read_whole_words(path, HEADER_BYTES, 1, block_words=2**22):
        missing = count_missing_bytes(np.frombuffer(block, np.uint8), missing, LONE[is_atis])
    return missing > 0
