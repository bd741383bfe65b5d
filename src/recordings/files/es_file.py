"""Event Stream files (.es, github.com/neuromorphicsystems/event_stream), by faery."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import faery

from src.recordings.files.event_file import EventFile, RawEvents, ReadOptions


class EsFile(EventFile):
    """An `.es` file of DVS or ATIS events; times are microseconds."""

    time_unit = "us"

    def __init__(self, path: Path, options: ReadOptions):
        self.path = path
        with _named(path):
            self._decoder = faery.events_stream_from_file(path, file_type="es")
            self.size = self._decoder.dimensions()

    def pieces(self) -> Iterator[RawEvents]:
        """Yield the events; raises ValueError for a file that cannot be decoded."""
        decoded = iter(self._decoder)
        while True:
            with _named(self.path):
                events = next(decoded, None)
            if events is None:
                return
            yield RawEvents(events["t"].view("i8"), events["x"], events["y"], events["on"])


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Errors of the decoder, panics of compiled code too, which are no Exception, name the file."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit, MemoryError):
        raise
    except BaseException as error:
        raise ValueError(f"{path}: cannot be decoded: {error}") from error
