"""The page's buffer: the last frames, the x-t slice through them, the events since a picture ago.

Written by the threads that cut and reconstruct, read by the page's.
"""

import threading

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from src.recordings.engines.splat import mark
from src.recordings.lookup import Lookup
from src.recordings.views import Size

MOST_BYTES = 1 << 26  # of frames kept
COLUMNS = 600  # frames in a slice: a second at 600 fps
Line = tuple[float, float, float, float]  # x0, y0, x1, y1 in pixels of the picture


class Screen:
    """Keeps COLUMNS frames of `size` (height, width), fewer where they are large."""

    def __init__(self, size: Size):
        self.size = size
        kept = max(2, min(COLUMNS, MOST_BYTES // (size[0] * size[1])))
        self.ring = np.zeros((kept, *size), np.uint8)
        self.count = 0  # frames shown since the start

    def show(self, picture: Float[np.ndarray, "h w"]) -> None:
        """Put a frame in [0, 1] into the buffer."""
        cv2.convertScaleAbs(picture, dst=self.ring[self.count % len(self.ring)], alpha=255)
        self.count += 1

    def newest(self) -> UInt8[np.ndarray, "h w"] | None:
        """Return a copy of the newest frame; None before the first."""
        count = self.count
        return self.ring[(count - 1) % len(self.ring)].copy() if count else None


class Slice:
    """The pixels along a line, one column per frame, the newest on the right.

    Only frames that are new since the last call are looked at, unless the line has moved.
    """

    def __init__(self, screen: Screen):
        self.screen = screen
        height, width = screen.size
        self.line: Line = (0.0, height / 2, width - 1.0, height / 2)
        self.drawn: tuple[Line, int] | None = None  # what `picture` shows
        self.picture = np.zeros((1, len(screen.ring)), np.uint8)

    def draw(self, *, anew: bool = False) -> UInt8[np.ndarray, "samples frames"] | None:
        """Return the slice; None where it is still that of the last call, unless `anew`."""
        line, count = self.line, self.screen.count
        if self.drawn == (line, count):
            return self.picture if anew else None
        kept = len(self.screen.ring)
        moved = self.drawn is None or self.drawn[0] != line
        news = min(count if moved else count - self.drawn[1], kept)
        x, y = self._samples(line)
        columns = self.screen.ring[np.arange(count - news, count) % kept][:, y, x].T
        if moved:
            self.picture = np.zeros((len(x), kept), np.uint8)
        self.picture = np.concatenate([self.picture[:, news:], columns], axis=1)
        self.drawn = (line, count)
        return self.picture

    def _samples(self, line: Line) -> tuple[Int[np.ndarray, " k"], Int[np.ndarray, " k"]]:
        """Return the pixels along the line, about one for each it passes."""
        x0, y0, x1, y1 = line
        height, width = self.screen.size
        k = max(2, round(max(abs(x1 - x0), abs(y1 - y0))) + 1)
        x, y = np.linspace(x0, x1, k), np.linspace(y0, y1, k)
        rounded = np.rint(np.clip(x, 0, width - 1)), np.rint(np.clip(y, 0, height - 1))
        return rounded[0].astype(int), rounded[1].astype(int)


class EventPicture:
    """Polarities added up in every view since the last `take`; nothing while nobody looks."""

    def __init__(self, lookup: Lookup):
        self.lookup = lookup
        self.lock = threading.Lock()
        self.watched = False
        self.windows = 0  # added since the last `take`
        size = (lookup.views, *lookup.model)
        self.counts, self.taken = np.zeros(size, np.int32), np.zeros(size, np.int32)

    def add(self, events: np.ndarray) -> None:
        """Add a window's events (t x y p) of the sensor."""
        if self.watched:
            fields = (events[name] for name in "xyp")
            with self.lock:
                mark(*fields, self.lookup.nearest, self.counts)
                self.windows += 1

    def take(self) -> Int[np.ndarray, "views h w"]:
        """Return what came since the last call; it holds until the next."""
        self.taken.fill(0)
        with self.lock:
            self.counts, self.taken, self.windows = self.taken, self.counts, 0
        return self.taken
