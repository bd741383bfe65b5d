"""The page's pictures: the newest frames, the x-t slice through them, the events of each view.

Written by the threads that cut and reconstruct, read by the page's.  Colours are blue, green, red.
"""

import threading
import time
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from src.recordings.engines.splat import count_polarity
from src.recordings.files.event_arrays import contiguous_columns
from src.recordings.sensor_lookup import SensorLookup
from src.recordings.views import HeightWidth
from src.sim.optics import Position

MAX_BYTES = 1 << 26  # of frames kept
MAX_FRAMES = 600  # columns of a slice: a second at 600 fps
GREY_QUALITY, COLOUR_QUALITY = 88, 80  # of JPEG; coloured dots need less and cost most
MAX_SIDE = 264  # longer side in pixels of all views side by side, which take turns with the rest
BACKGROUND, OFF, ON = (24, 21, 19), (255, 150, 70), (90, 190, 255)
BORDER = (90, 90, 90)  # between views
FULL_COLOUR = 2  # events at a pixel that are drawn at full colour
_SHARE = np.abs(np.linspace(-1, 1, 2 * FULL_COLOUR + 1))[:, None] ** 0.6
_ENDS = np.array([OFF] * FULL_COLOUR + [BACKGROUND] + [ON] * FULL_COLOUR)
COLOURS = np.zeros((256, 1, 3), np.uint8)  # of -FULL_COLOUR ... FULL_COLOUR events, then black
COLOURS[: len(_ENDS), 0] = _SHARE * _ENDS + (1 - _SHARE) * np.array(BACKGROUND)
Line = tuple[float, float, float, float]  # x0, y0, x1, y1 in pixels of the picture


class FrameRing:
    """Keeps MAX_FRAMES frames of `size` (height, width), fewer where they are large.

    `ring` holds them, the newest at (`count` - 1) modulo its length.
    """

    def __init__(self, size: HeightWidth):
        self.size = size
        kept = max(2, min(MAX_FRAMES, MAX_BYTES // (size[0] * size[1])))
        self.ring = np.zeros((kept, *size), np.uint8)
        self.pushed_s = np.zeros(kept)  # wall time of each frame of the ring
        self.count = 0  # frames since the start

    def push(self, picture: Float[np.ndarray, "h w"]) -> None:
        """Add a frame in [0, 1]."""
        cv2.convertScaleAbs(picture, dst=self.ring[self.count % len(self.ring)], alpha=255)
        self.pushed_s[self.count % len(self.ring)] = time.perf_counter()
        self.count += 1

    def measure_length_s(self) -> float | None:
        """Return the wall time from the oldest to the newest frame of the ring in seconds; None of
        fewer than two."""
        pushed_s = self.pushed_s[: self.count].copy()
        return float(np.ptp(pushed_s)) if len(pushed_s) > 1 else None

    def newest(self) -> UInt8[np.ndarray, "h w"] | None:
        """Return a copy of the newest frame; None before the first."""
        count = self.count
        return self.ring[(count - 1) % len(self.ring)].copy() if count else None


class TimeSlice:
    """The x-t slice: the pixels along `line`, one column per frame, the newest on the right.

    Only frames that are new since the last call are read, unless the line has moved.
    """

    def __init__(self, frames: FrameRing):
        self.frames = frames
        height, width = frames.size
        self.line: Line = (0.0, height / 2, width - 1.0, height / 2)
        self.drawn: tuple[Line, int] | None = None  # line and frame count of `picture`
        self.given: tuple[Line, int] | None = None  # those of the last one that was asked as new
        self.picture = np.zeros((1, len(frames.ring)), np.uint8)

    def draw(self, *, always: bool = False) -> UInt8[np.ndarray, "samples frames"] | None:
        """Return the slice; None where it is still that of the last call that was not `always`."""
        line, count = self.line, self.frames.count
        if not always and self.given == (line, count):
            return None
        if not always:
            self.given = line, count
        if self.drawn == (line, count):
            return self.picture
        kept = len(self.frames.ring)
        before = self.drawn[1] if self.drawn is not None and self.drawn[0] == line else None
        new = min(count if before is None else count - before, kept)
        x, y = self._sample_pixels(line)
        columns = self.frames.ring[np.arange(count - new, count) % kept][:, y, x].T
        if before is None:
            self.picture = np.zeros((len(x), kept), np.uint8)
        self.picture = np.concatenate([self.picture[:, new:], columns], axis=1)
        self.drawn = (line, count)
        return self.picture

    def _sample_pixels(self, line: Line) -> Int[np.ndarray, "2 k"]:
        """Return x and y of the pixels along the line, about one for each it passes."""
        x0, y0, x1, y1 = line
        height, width = self.frames.size
        k = max(2, round(max(abs(x1 - x0), abs(y1 - y0))) + 1)
        points = np.linspace((x0, y0), (x1, y1), k).clip(0, (width - 1, height - 1))
        return np.rint(points).astype(int).T


class PolarityAccumulator:
    """Sums of polarity per pixel of every view since the last `take`; idle unless `is_watched`."""

    def __init__(self, lookup: SensorLookup):
        self.lookup = lookup
        self.lock = threading.Lock()
        self.is_watched = False
        self.windows = 0  # added since the last `take`
        size = (lookup.views, *lookup.model)
        self.counts, self.taken = np.zeros(size, np.int32), np.zeros(size, np.int32)

    def add(self, events: np.ndarray) -> None:
        """Add a window's events (t x y p) of the sensor."""
        if self.is_watched:
            x, y, p = contiguous_columns(events, "xyp")
            with self.lock:
                count_polarity(x, y, p, self.lookup.nearest_model_pixel, self.counts)
                self.windows += 1

    def take(self) -> Int[np.ndarray, "views h w"]:
        """Return the sums, `taken` until the next call, and start anew."""
        self.taken.fill(0)
        with self.lock:
            self.counts, self.taken, self.windows = self.taken, self.counts, 0
        return self.taken


def draw_events(counts: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return polarities added up at each pixel in colour: ON warm, OFF cool."""
    steps = (np.clip(counts, -FULL_COLOUR, FULL_COLOUR) + FULL_COLOUR).astype(np.uint8)
    return cv2.applyColorMap(steps, COLOURS)


def tile_views_without_gaps(
    counts: Int[np.ndarray, "views h w"], positions: Sequence[Position]
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the events of all views in their order in the light field, rows and columns without a
    view left out, made small, a line of one pixel between them; each view keeps two pixels of a
    side, where it has them.
    """
    rows, columns = (sorted({place[axis] for place in positions}) for axis in (0, 1))
    _, height, width = counts.shape
    shrink = max(1, -(-max(len(rows) * height, len(columns) * width) // MAX_SIDE))
    down, across = (min(shrink, max(1, side // 2)) for side in (height, width))
    high, wide = height // down, width // across
    kept = counts[:, : high * down, : wide * across]
    small = kept.reshape(-1, high, down, wide, across).sum((2, 4))
    whole = np.zeros((len(rows) * high, len(columns) * wide), counts.dtype)
    for view, (row, column) in zip(small, positions, strict=True):
        top, left = rows.index(row) * high, columns.index(column) * wide
        whole[top : top + high, left : left + wide] = view
    drawn = draw_events(whole)
    if high > 1:
        drawn[high::high] = BORDER
    if wide > 1:
        drawn[:, wide::wide] = BORDER
    return drawn


def encode_jpeg(picture: UInt8[np.ndarray, "..."]) -> bytes:
    """Return a grey or colour picture as JPEG, colours at full resolution."""
    full = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    quality = GREY_QUALITY if picture.ndim == 2 else COLOUR_QUALITY
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, full]
    return cv2.imencode(".jpg", picture, how)[1].tobytes()
