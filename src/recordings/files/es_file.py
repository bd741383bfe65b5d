"""Event Stream files (.es, github.com/neuromorphicsystems/event_stream), by faery."""

from collections.abc import Iterator
from pathlib import Path

import faery

from src.recordings.files.event_file import EventFile, RawEvents, ReadOptions, name_file_in_errors


class EsFile(EventFile):
    """An `.es` file of DVS or ATIS events; times are microseconds."""

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with name_file_in_errors(path, "cannot be decoded"):
            self._decoder = faery.events_stream_from_file(path, file_type="es")
            self.size = self._decoder.dimensions()

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; raises ValueError for a file that cannot be decoded."""
        with name_file_in_errors(self.path, "cannot be decoded"):
            for events in self._decoder:
                yield RawEvents(events["t"].view("i8"), events["x"], events["y"], events["on"])
