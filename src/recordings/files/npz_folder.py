"""A folder of .npz files, one after the other in order of name, beside a folder of pictures: the
layout of TimeLens's recordings (HS-ERGB, BS-ERGB; Tulyakov et al. 2021, 2022) and of Event-Field.

    events/000000.npz ...   images/000000.png ...   images/timestamp.txt
"""

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import EventFile, RawEvents, RawFrames, ReadOptions
from src.recordings.files.frame_files import find_timelens_frames
from src.recordings.files.lazy_columns import ENOUGH_EVENTS, find_order_of_windows
from src.recordings.files.numpy_file import NumpyFile, read_nameless_table
from src.sim.scenes.video_files import sort_naturally

EVENT_FOLDERS = (".", "events", "events_aligned")
FRACTIONS = 32  # of a pixel in which BS-ERGB has x and y, in 16 bits


def find_npz_folder(path: Path) -> Path | None:
    """Return the folder of .npz files that `path` is or has; None where there is none."""
    folders = (path / name for name in EVENT_FOLDERS)
    return next((folder for folder in folders if _list_npz(folder)), None)


def _list_npz(folder: Path) -> list[Path]:
    """Return the .npz files of a folder, but hidden ones, in order of name."""
    return sort_naturally(path for path in folder.glob("*.npz") if path.name[0] != ".")


class NpzFolder(EventFile):
    """The events of all files of a folder.

    Coordinates beyond twice the frames' size are in 1/32 pixel, as BS-ERGB has them: they are
    rounded, what is left of the first pixel or beyond the last is put there (EVREAL's rule).
    """

    def __init__(self, path: Path, options: ReadOptions):
        self.path, self._options = path, options
        self._folder = find_npz_folder(path) or path
        self._names, self._order = _list_npz(self._folder), None
        if options.columns is None:
            tables = (read_nameless_table(name, options) for name in self._names)
            self._order = find_order_of_windows(tables)
        first = self._open(self._names[0])
        self.size, self.notes, self.time_unit = first.size, first.notes, first.time_unit

    def _open(self, name: Path) -> NumpyFile:
        """Return a window; one whose columns have names takes these, not the common order."""
        if self._order is not None:
            with suppress(ValueError):
                return NumpyFile(name, replace(self._options, columns=self._order))
        return NumpyFile(name, self._options)

    def pieces(self) -> Iterator[RawEvents]:
        for name in self._names:
            for t, x, y, p in self._open(name).pieces():
                yield RawEvents(t, *self._whole_pixels(x, y), p)

    def times(self) -> Iterator[np.ndarray]:
        for name in self._names:
            yield from self._open(name).times()

    def frames(self) -> RawFrames | None:
        return self._frames

    @cached_property
    def _frames(self) -> RawFrames | None:
        return find_timelens_frames(self._folder)

    @cached_property
    def _has_fractions(self) -> bool:
        if self._frames is None:
            return False
        seen, largest = 0, 0
        for name in self._names:
            for piece in self._open(name).pieces():
                seen, largest = seen + len(piece.x), max(largest, piece.x.max(initial=0))
            if seen >= ENOUGH_EVENTS:
                break
        return bool(largest > 2 * self._frames.size[1])

    def _whole_pixels(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not self._has_fractions or self._frames is None:
            return x, y
        height, width = self._frames.size
        sides = ((x, width), (y, height))
        whole_x, whole_y = (_round(values, side - 1) for values, side in sides)
        return whole_x, whole_y


def _round(values: np.ndarray, last: int) -> np.ndarray:
    """Return values in 1/32 pixel as pixels 0..last; what is above came from below 0 in 16 bits."""
    values = values.astype(np.int64)
    values = np.where(values > last * FRACTIONS, values - 2**16, values)
    return np.rint(values / FRACTIONS).astype(np.int64).clip(0, last)
