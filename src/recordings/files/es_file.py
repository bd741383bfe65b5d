"""Event Stream files (.es, github.com/neuromorphicsystems/event_stream), by faery."""

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from src.recordings.engines.es_bytes import LONE_ATIS, LONE_DVS, count_events
from src.recordings.files.blocks import find_end_before_zeros, read_whole_words
from src.recordings.files.event_file import EventFile, RawEvents, ReadOptions, name_file_in_errors

HEADER_BYTES, KIND_AT, ATIS = 20, 15, 2


class EsFile(EventFile):
    """An `.es` file of DVS or ATIS events; times are microseconds."""

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        import faery  # here, as loading it takes a tenth of the start of a command

        with name_file_in_errors(path, "cannot be decoded"):
            self._decoder = faery.events_stream_from_file(path, file_type="es")
            self.size = self._decoder.dimensions()

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; warns of a file that ends within one or in zeros, which are left out;
        raises ValueError for one that cannot be decoded."""
        _, zeros = find_end_before_zeros(self.path, HEADER_BYTES)
        whole = _count_events(self.path)[0] if zeros else 0
        with name_file_in_errors(self.path, "cannot be decoded"):
            for found in self._decoder:
                events = found[:whole] if zeros else found
                whole -= len(events)
                yield RawEvents(events["t"].view("i8"), events["x"], events["y"], events["on"])
        if not zeros and _count_events(self.path)[1]:
            warnings.warn(f"{self.path}: ends within an event, it is truncated", stacklevel=2)


def _count_events(path: Path) -> tuple[int, int]:
    """Return how many events a file gives, zeros at its end aside, and how many bytes of the last
    one are missing."""
    with path.open("rb") as file:
        is_atis = file.read(HEADER_BYTES)[KIND_AT] == ATIS
    count, missing = 0, 0
    for block in read_whole_words(path, HEADER_BYTES, 1, block_words=2**22):
        found, missing = count_events(
            np.frombuffer(block, np.uint8), missing, LONE_ATIS if is_atis else LONE_DVS
        )
        count += found
    return count, missing
