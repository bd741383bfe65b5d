"""Picture and video files as OpenCV reads them: a video file, a folder of frames, or a folder of
these; grey, 8 bits.
"""

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8
from numpy.typing import NDArray

PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff"}
VIDEO_SUFFIXES = {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv"}
LARGEST_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])  # src/__init__.py sets 2^27


@dataclass(frozen=True)
class VideoSource:
    """One video of `count` frames: the file `path`, or the pictures `frames`, all of `size` (h, w)
    or as large as the first.  Errors name `key`.
    """

    name: str
    count: int
    key: str
    path: Path | None = None
    frames: tuple[Path, ...] = ()
    size: tuple[int, ...] | None = None

    def read(self, first: int, stop: int) -> Iterator[UInt8[np.ndarray, "h w"]]:
        """Yield frames first .. stop - 1; raises ValueError for one that cannot be read or is of
        another size.
        """
        if self.path is not None:
            video = open_video(self.path, self.key)
            video.set(cv2.CAP_PROP_POS_FRAMES, first)
            for number in range(first, stop):
                there, frame = video.read()
                if not there:
                    place = f"{self.path} at {number}"
                    raise ValueError(f"{self.key} must be readable throughout, got {place}")
                yield cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            video.release()
        size = self.size
        for path in self.frames[first:stop]:
            picture = read_picture(path)
            if picture is None:
                raise ValueError(f"{self.key} must hold frames that can be read, got {path}")
            size = size or picture.shape
            if picture.shape != size:
                wanted, (height, width) = f"{size[1]}x{size[0]} px", picture.shape
                raise ValueError(
                    f"{self.key} must hold frames of {wanted}, got {width}x{height} in {path}"
                )
            yield picture


def find_videos(root: Path, key: str = "scene.root") -> list[VideoSource]:
    """Return the videos at `root` by name.

    Raises ValueError, which names `key`, where there are none.
    """
    if root.is_file():
        return [_file_source(root, key)]
    entries = sorted(path for path in root.iterdir() if path.name[0] != ".")
    videos = _folder_sources(root, key) or [
        *(_file_source(path, key) for path in entries if path.suffix.lower() in VIDEO_SUFFIXES),
        *(one for path in entries if path.is_dir() for one in _folder_sources(path, key)),
    ]
    if not videos:
        raise ValueError(f"{key} must hold videos or folders of frames, got none in {root}")
    return videos


def _folder_sources(path: Path, key: str) -> list[VideoSource]:
    """Return the folder as one video, none where no frames are in it."""
    names = sorted(path.iterdir())
    frames = [p for p in names if p.suffix.lower() in PICTURE_SUFFIXES and p.name[0] != "."]
    return [VideoSource(path.name, len(frames), key, frames=tuple(frames))] if frames else []


def _file_source(path: Path, key: str) -> VideoSource:
    video = open_video(path, key)
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if count < 2:
        raise ValueError(f"{key} must be a video of two frames or more, got {path}")
    return VideoSource(path.stem, count, key, path=path)


def open_video(path: Path, key: str) -> cv2.VideoCapture:
    """Return a video to read from.

    Raises ValueError, which names `key`, for a file that is none or has frames of more than
    LARGEST_PIXELS.
    """
    video = cv2.VideoCapture(str(path))
    size = video.get(cv2.CAP_PROP_FRAME_WIDTH), video.get(cv2.CAP_PROP_FRAME_HEIGHT)
    if not (video.isOpened() and math.prod(size) <= LARGEST_PIXELS):
        raise ValueError(
            f"{key} must be a video that OpenCV can read, with frames of at most {LARGEST_PIXELS} "
            f"pixels, got {path}"
        )
    return video


def read_picture(source: Path | bytes, flags: int = cv2.IMREAD_GRAYSCALE) -> NDArray | None:
    """Return the picture (h, w) of a file or of its bytes, or None where it is none or has more
    than LARGEST_PIXELS, as a small file could unpack to gigabytes.
    """
    try:
        if isinstance(source, bytes):
            return cv2.imdecode(np.frombuffer(source, np.uint8), flags)
        return cv2.imread(str(source), flags)
    except cv2.error:
        return None
