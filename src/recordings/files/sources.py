"""What is looked at: events of a sensor of known size, a sensor picture, a film."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import h5py
import numpy as np
from jaxtyping import Float

from src.recordings.files import columns, formats
from src.sim.scenes.pictures import LARGEST_PIXELS, open_video, read_picture

Size = tuple[int, int]  # height, width
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
FASTEST = 1e7  # frames a second that are believed
FILMS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".gif")


def sensor_size(path: Path | str, sensor: Sequence[int] | None = None) -> Size:
    """Return (height, width) of the recording's sensor; `sensor` for a file that does not say.

    Raises ValueError where neither says, or both do and differ.
    """
    size = formats.open_events(path).size
    stated = size and size[::-1]
    if stated is None and sensor is None:
        raise ValueError(f"{path} does not state its sensor; give sensor_size=[height,width]")
    if None not in (stated, sensor) and tuple(sensor) != stated:
        raise ValueError(f"sensor_size must be {stated}, as {path} states, got {tuple(sensor)}")
    return stated or tuple(sensor)


def events(path: Path | str, sensor: Size, seconds: float = 0.05) -> Iterator[np.ndarray]:
    """Yield the events of a recording, `seconds` at a time."""
    return formats.iter_events(path, seconds=seconds, size=sensor[::-1])


def sensor_picture(
    path: Path | str, sensor: Sequence[int] | None = None
) -> Float[np.ndarray, "h w"]:
    """Return a picture in [0, 1], the mean of a film, or the events of each pixel of a recording.

    A target that blinks on a dark screen makes events where it is bright: their count shows it.
    Raises ValueError for a file that cannot be read.
    """
    path = Path(path)
    if path.suffix.lower() in PICTURES:
        return _picture(path)
    if not holds_events(path):
        total, count = 0.0, 0
        for frame in film(path):
            total, count = total + frame, count + 1
        return total / count
    counts = np.zeros(sensor_size(path, sensor))
    for chunk in events(path, counts.shape):
        pixels = np.ravel_multi_index((chunk["y"], chunk["x"]), counts.shape)
        counts += np.bincount(pixels, minlength=counts.size).reshape(counts.shape)
    return counts


def holds_events(path: Path | str) -> bool:
    """Return whether `path` is none of: folder of pictures, picture, film, our `video.h5`."""
    path = Path(path)
    if path.is_dir() or path.suffix.lower() in PICTURES + FILMS:
        return False
    return not (path.suffix == ".h5" and _has_frames(path))


def film(path: Path | str, key: str = "recording") -> Iterator[Float[np.ndarray, "h w"]]:
    """Yield the grey frames in [0, 1], float32, of a film, a folder of pictures or our `video.h5`.

    Raises ValueError, which names `key`, for a file that cannot be read or has no frame.
    """
    frame = None
    for frame in _frames(Path(path), key):
        yield frame
    if frame is None:
        raise ValueError(f"{key} must be a film or a folder of pictures, got {path}")


def frame_rate(path: Path | str) -> float | None:
    """Return the frames a second that a film states; None for pictures, and where it says nothing.

    Raises ValueError for a film that cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return None
    if path.suffix == ".h5":
        return _rate_h5(path)
    rate = open_video(path, "video").get(cv2.CAP_PROP_FPS)
    return rate if 0 < rate < FASTEST else None


def _frames(path: Path, key: str) -> Iterator[np.ndarray]:
    if path.is_dir():
        names = sorted(name for name in path.iterdir() if name.suffix.lower() in PICTURES)
        yield from map(_picture, names)
    elif path.suffix == ".h5":
        for frame in _video_h5(path):
            yield frame.astype(np.float32) / 255
    else:
        video = open_video(path, key)
        while (read := video.read())[0]:
            yield cv2.cvtColor(read[1], cv2.COLOR_BGR2GRAY).astype(np.float32) / 255


def _video_h5(path: Path) -> Iterator[np.ndarray]:
    try:
        with h5py.File(path) as file:
            columns.check_inside(file)
            frames = file["frames"]
            if frames.ndim != 3 or frames.dtype != np.uint8:
                raise ValueError("frames must be uint8 (n, h, w)")
            if math.prod(frames.shape[1:]) > LARGEST_PIXELS:
                raise ValueError(f"frames must have {LARGEST_PIXELS} pixels at most")
            yield from frames
    except Exception as error:  # HDF5 raises all kinds on a broken file
        raise ValueError(f"{path}: cannot be read as a video: {error}") from error


def _rate_h5(path: Path) -> float | None:
    try:
        with h5py.File(path) as file:
            columns.check_inside(file)
            times = file["time_s"][:2] if "time_s" in file else []
    except Exception as error:  # HDF5 raises all kinds on a broken file
        raise ValueError(f"{path}: cannot be read as a video: {error}") from error
    return float(1 / (times[1] - times[0])) if len(times) == 2 and times[1] > times[0] else None


def _picture(path: Path) -> np.ndarray:
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is None or picture.dtype.kind != "u":
        raise ValueError(
            f"recording must be a readable picture of at most {LARGEST_PIXELS} pixels, got {path}"
        )
    return picture.astype(np.float32) / np.iinfo(picture.dtype).max


def _has_frames(path: Path) -> bool:
    try:
        with h5py.File(path) as file:
            return "frames" in file
    except OSError:
        return False
