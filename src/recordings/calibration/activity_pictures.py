"""Pictures of what changed, or was seen, in windows that share a recording of any length.

The windows double in length, and are joined in pairs, whenever there are more than WINDOWS: memory
does not grow.  All views see the same in a window, so it may be long.
"""

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from src.recordings.files import recording_inputs, videos
from src.recordings.files.event_file import ReadOptions
from src.recordings.views import HeightWidth
from src.sim.scenes.video_files import PICTURE_SUFFIXES

WINDOWS = 16
LINES = 160  # at least so many along the longer side of pictures that are shrunk
FIRST_WINDOW_US = 5000
FINE_SIGMA_PX = 1.2  # of `band_pass_log`
MIN_CONTRAST = 0.05  # of the window with the largest; windows of noise have less
Pictures = Float[np.ndarray, "windows kinds h w"]


class DoublingWindowSums:
    """Sums of pictures (kinds, h, w) over up to WINDOWS windows of one `length`, in order."""

    def __init__(self, shape: tuple[int, ...], length: int):
        self.shape, self.length = shape, length
        self.windows: list[np.ndarray] = []

    def add(self, time: int, picture: np.ndarray) -> None:
        """Add a picture to the window that holds `time`, 0 or more, in the unit of `length`."""
        while time // self.length >= WINDOWS:
            pairs = range(0, len(self.windows), 2)
            self.windows = [np.sum(self.windows[first : first + 2], axis=0) for first in pairs]
            self.length *= 2
        while len(self.windows) <= time // self.length:
            self.windows.append(np.zeros(self.shape, np.float32))
        self.windows[time // self.length] += picture


def read_activity_pictures(
    path: Path | str, sensor: Sequence[int] | None = None, options: ReadOptions = ReadOptions()
) -> Pictures:
    """Return the events of each pixel, ON and OFF apart, or the mean of a film's code values (0 to
    255), in up to WINDOWS windows of a recording.  Raises ValueError for what cannot be read."""
    if (path := Path(path)).suffix.lower() in PICTURE_SUFFIXES:
        return 255 * videos.read_gray_picture(path)[None, None].astype(np.float32)
    if not recording_inputs.has_events(path):
        return _average_film(videos.read_video(path))
    size = recording_inputs.find_sensor_size(path, sensor, options)
    return _count_events(
        recording_inputs.iter_recording(path, size, FIRST_WINDOW_US * 1e-6, options), size
    )


def shrink_pictures(
    pictures: Float[np.ndarray, "*windows h w"], factor: int
) -> Float[np.ndarray, "n small_h small_w"]:
    """Return means over squares of `factor` pixels; what is left right and below is cut."""
    flat = pictures.reshape(-1, *pictures.shape[-2:])
    height, width = (side // factor for side in flat.shape[1:])
    cut = flat[:, : height * factor, : width * factor]
    return cut.reshape(-1, height, factor, width, factor).mean((2, 4))


def band_pass_log(
    pictures: Float[np.ndarray, "n h w"], coarse_sigma_px: float
) -> Float[np.ndarray, "n h w"]:
    """Return the logarithm of pictures between two scales, FINE_SIGMA_PX and `coarse_sigma_px`,
    sigmas of Gaussians; a pixel far above its neighbours, a hot one, counts as three times their
    median."""
    bands = []
    for picture in pictures:
        capped = np.log1p(np.minimum(picture, 3 + 3 * cv2.medianBlur(picture, 5)))
        fine, coarse = (
            cv2.GaussianBlur(capped, (0, 0), s) for s in (FINE_SIGMA_PX, coarse_sigma_px)
        )
        bands.append(fine - coarse)
    return np.stack(bands)


def extract_coarse_edges(
    pictures: Float[np.ndarray, "*windows h w"],
) -> tuple[Float[np.ndarray, "n small_h small_w"], int]:
    """Return the edges of pictures shrunk to LINES or more, and the factor in pixels."""
    factor = max(1, max(pictures.shape[-2:]) // LINES)
    return band_pass_log(shrink_pictures(pictures, factor), 2.5), factor


def measure_squared_contrast(
    pictures: Float[np.ndarray, "*windows h w"],
) -> tuple[Float[np.ndarray, "n small_h small_w"], int]:
    """Return the squared edges of pictures shrunk to LINES or more, and the factor in pixels.

    It is the product of two pictures of every second pixel each: both show the scene, and noise,
    which differs from pixel to pixel, cancels.
    """
    y, x = np.indices(pictures.shape[-2:])
    every_second = ((y + x) % 2).astype(np.float32)
    (one, step), (other, _) = (
        extract_coarse_edges(pictures * kept) for kept in (every_second, 1 - every_second)
    )
    return one * other, step


def keep_windows_with_motion(pictures: Pictures) -> Float[np.ndarray, "kept kinds h w"]:
    """Return the windows whose contrast is MIN_CONTRAST or more of the largest; all if none has."""
    square = measure_squared_contrast(pictures)[0].reshape(len(pictures), -1).mean(1)
    kept = square >= MIN_CONTRAST**2 * square.max()
    return pictures[kept] if kept.any() else pictures


def _average_film(frames: Iterator[np.ndarray]) -> Pictures:
    sums = None
    for index, frame in enumerate(frames):
        sums = sums or DoublingWindowSums((2, *frame.shape), 1)  # of code values, and of frames
        if frame.shape != sums.shape[1:]:
            got = f"{frame.shape} after {sums.shape[1:]}"
            raise ValueError(f"recording must hold frames of one size, got {got}")
        sums.add(index, np.stack([255 * frame, np.ones_like(frame)]))
    assert sums is not None, "read_video yields a frame or raises"
    return np.stack([window[:1] / window[1:] for window in sums.windows])


def _count_events(chunks: Iterator[np.ndarray], size: HeightWidth) -> Pictures:
    sums, start = DoublingWindowSums((2, *size), FIRST_WINDOW_US), None
    for events in chunks:
        start = int(events["t"][0]) if start is None else start
        place = np.ravel_multi_index((events["p"] > 0, events["y"], events["x"]), sums.shape)
        added = np.bincount(place, minlength=int(np.prod(sums.shape)))
        sums.add(int(events["t"][0]) - start, added.reshape(sums.shape))
    return np.stack([window for window in sums.windows if window.any()])
