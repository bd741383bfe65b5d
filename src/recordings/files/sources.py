"""Inputs of known size: events of a recording, a picture of the sensor, frames of a video."""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path

import cv2
import h5py
import numpy as np
from jaxtyping import Float

from src.recordings.files import columns, formats
from src.sim.scenes.video_files import LARGEST_PIXELS, open_video, read_picture

Size = tuple[int, int]  # height, width
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
MAX_FPS = 1e7  # that is believed
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif")


def sensor_size(path: Path | str, sensor: Sequence[int] | None = None) -> Size:
    """Return (height, width) of the recording's sensor; `sensor` for a file that does not say.

    Raises ValueError where neither says, or both do and differ.
    """
    size = formats.open_recording(path).size
    stated = size and size[::-1]
    given = (sensor[0], sensor[1]) if sensor is not None else stated
    if given is None:
        raise ValueError(f"{path} does not state its sensor; give sensor_size=[height,width]")
    if stated not in (None, given):
        raise ValueError(f"sensor_size must be {stated}, as {path} states, got {given}")
    return given


def iter_recording(path: Path | str, sensor: Size, seconds: float = 0.05) -> Iterator[np.ndarray]:
    """Yield the events of a recording, `seconds` at a time."""
    return formats.iter_events(path, seconds=seconds, size=sensor[::-1])


def read_sensor_picture(
    path: Path | str, sensor: Sequence[int] | None = None
) -> Float[np.ndarray, "h w"]:
    """Return a picture in [0, 1], the mean of a film, or the number of events of each pixel, which
    shows a target that blinks on a dark screen.  Raises ValueError for what cannot be read."""
    path = Path(path)
    if path.suffix.lower() in PICTURES:
        return _picture(path)
    if not has_events(path):
        frames = read_video(path)
        total, count = next(frames), 1
        for frame in frames:
            total, count = total + frame, count + 1
        return total / count
    counts = np.zeros(sensor_size(path, sensor))
    for chunk in iter_recording(path, counts.shape):
        pixels = np.ravel_multi_index((chunk["y"], chunk["x"]), counts.shape)
        counts += np.bincount(pixels, minlength=counts.size).reshape(counts.shape)
    return counts


def has_events(path: Path | str) -> bool:
    """Return whether `path` is none of: folder of pictures, picture, film, our `video.h5`."""
    path = Path(path)
    if path.is_dir() or path.suffix.lower() in PICTURES + VIDEOS:
        return False
    try:
        with h5py.File(path) if path.suffix == ".h5" else nullcontext({}) as file:
            return "frames" not in file
    except OSError:
        return True


def read_video(path: Path | str, key: str = "recording") -> Iterator[Float[np.ndarray, "h w"]]:
    """Yield the grey frames in [0, 1], float32, of a film, a folder of pictures or our `video.h5`.

    Raises ValueError, which names `key`, for a file that cannot be read or has no frame.
    """
    frame = None
    for frame in _frames(Path(path), key):
        yield frame
    if frame is None:
        raise ValueError(f"{key} must be a film or a folder of pictures, got {path}")


def stated_fps(path: Path | str) -> float | None:
    """Return the frames a second that a film states; None for pictures, and where it says nothing.

    Raises ValueError for a film that cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return None
    if path.suffix == ".h5":
        with _opened_h5(path) as file:
            times = file["time_s"][:2] if "time_s" in file else []
        known = len(times) == 2 and times[1] > times[0]
        return float(1 / (times[1] - times[0])) if known else None
    rate = open_video(path, "video").get(cv2.CAP_PROP_FPS)
    return rate if 0 < rate < MAX_FPS else None


def _frames(path: Path, key: str) -> Iterator[np.ndarray]:
    if path.is_dir():
        names = sorted(name for name in path.iterdir() if name.suffix.lower() in PICTURES)
        yield from map(_picture, names)
    elif path.suffix == ".h5":
        with _opened_h5(path) as file:
            frames = file["frames"]
            if frames.ndim != 3 or frames.dtype != np.uint8:
                raise ValueError("frames must be uint8 (n, h, w)")
            if math.prod(frames.shape[1:]) > LARGEST_PIXELS:
                raise ValueError(f"frames must have {LARGEST_PIXELS} pixels at most")
            yield from (frame.astype(np.float32) / 255 for frame in frames)
    else:
        video = open_video(path, key)
        while (read := video.read())[0]:
            yield cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY).astype(np.float32) / 255


@contextmanager
def _opened_h5(path: Path) -> Iterator[h5py.File]:
    """Open our `video.h5`; errors in the block are ValueErrors that name it."""
    try:
        with h5py.File(path) as file:
            columns.check_no_external_data(file)
            yield file
    except Exception as error:  # HDF5 raises all kinds on a broken file
        raise ValueError(f"{path}: cannot be read as a video: {error}") from error


def _picture(path: Path) -> np.ndarray:
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is None or picture.dtype.kind != "u":
        raise ValueError(
            f"recording must be a readable picture of at most {LARGEST_PIXELS} pixels, got {path}"
        )
    return picture.astype(np.float32) / np.iinfo(picture.dtype).max
