"""Frames of a film, a folder of pictures or our `video.h5`: grey, in [0, 1]."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

import cv2
import h5py
import numpy as np
from jaxtyping import Float

from src.recordings.files.event_file import name_file_in_errors
from src.recordings.files.frame_files import list_pictures
from src.recordings.files.hdf5_file import check_hdf5_safety
from src.sim.scenes.video_decoding import LARGEST_PIXELS
from src.sim.scenes.video_files import read_picture
from src.sim.scenes.video_index import index_video


def read_video(
    path: Path | str, config_key: str = "recording", max_frames: int | None = None
) -> Iterator[Float[np.ndarray, "h w"]]:
    """Yield the grey frames in [0, 1], float32, of a film, a folder of pictures or our `video.h5`;
    of a film that is long at most its first `max_frames` frames.

    Raises ValueError, which names `config_key`, for a file that cannot be read or has no frame.
    """
    frame = None
    for frame in islice(_frames(Path(path), config_key, max_frames), max_frames):
        yield frame
    if frame is None:
        raise ValueError(f"{config_key} must be a film or a folder of pictures, got {path}")


def read_fps(
    path: Path | str, config_key: str = "video", max_frames: int | None = None
) -> float | None:
    """Return the frames a second of a film, of its first `max_frames`: what it states, or what
    its time stamps say where that differs; None for pictures and for a film without time stamps.

    Raises ValueError, which names `config_key`, for a film that cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return None
    if path.suffix == ".h5":
        times = read_times(path)
        if times is None or len(times) < 2 or times[1] <= times[0]:
            return None
        return float(1 / (times[1] - times[0]))
    return index_video(path, config_key, max_frames).fps


def read_times(path: Path) -> Float[np.ndarray, " frames"] | None:
    """Return the seconds of the frames of our `video.h5`; None of a video that does not hold them.

    Raises ValueError for an HDF5 that cannot be read.
    """
    if path.suffix != ".h5":
        return None
    with _opened_h5(path) as file:
        return np.asarray(file["time_s"], np.float64) if "time_s" in file else None


def _frames(path: Path, config_key: str, max_frames: int | None) -> Iterator[np.ndarray]:
    if path.is_dir():
        for name in list_pictures(path):
            yield read_gray_picture(name, config_key)
    elif path.suffix == ".h5":
        with _opened_h5(path) as file:
            frames = file["frames"]
            if frames.ndim != 3 or frames.dtype != np.uint8:
                raise ValueError("frames must be uint8 (n, h, w)")
            if math.prod(frames.shape[1:]) > LARGEST_PIXELS:
                raise ValueError(f"frames must have {LARGEST_PIXELS} pixels at most")
            yield from (frame.astype(np.float32) / 255 for frame in frames)
    else:
        index = index_video(path, config_key, max_frames)
        for frame in index.read(0, len(index.constant_rate_frames), config_key):
            yield frame.astype(np.float32) / 255


@contextmanager
def _opened_h5(path: Path) -> Iterator[h5py.File]:
    """Open our `video.h5`; errors in the block are ValueErrors that name it."""
    with name_file_in_errors(path, "cannot be read as a video"), h5py.File(path) as file:
        check_hdf5_safety(file)
        yield file


def read_gray_picture(path: Path, config_key: str = "recording") -> Float[np.ndarray, "h w"]:
    """Return a picture in [0, 1], of 8 or 16 bits; raises ValueError, which names `config_key`, for
    what cannot be read."""
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
    if picture is None or picture.dtype.kind != "u":
        wanted = f"a readable picture of at most {LARGEST_PIXELS} pixels"
        raise ValueError(f"{config_key} must be {wanted}, got {path}")
    return picture.astype(np.float32) / np.iinfo(picture.dtype).max
