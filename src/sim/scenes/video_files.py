"""Pictures and videos: a video file, a folder of frames, or a folder of these; grey."""

import os
import re
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Shaped
from numpy.typing import NDArray

from src.sim.scenes.code_values import ALL_BITS, check_float_values

if TYPE_CHECKING:
    from src.sim.scenes.video_index import VideoIndex

PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".bmp", ".tif", ".tiff", ".webp"}
VIDEO_SUFFIXES = {
    ".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".ts", ".mts",
    ".m2ts", ".3gp", ".ogv", ".flv", ".gif",
}  # fmt: skip
JPEG_START, JPEG_SCAN, JPEG_END = b"\xff\xd8", b"\xda", b"\xff\xd9"


@dataclass(frozen=True)
class VideoSource:
    """One video of `count` frames: a file of `index`, or the pictures `frames`, all of `size`
    (h, w) or as large as the first.  Errors name `config_key`.
    """

    name: str
    count: int
    config_key: str
    index: "VideoIndex | None" = None
    frames: tuple[Path, ...] = ()
    size: tuple[int, ...] | None = None

    def read(
        self, first: int, stop: int, flags: int = cv2.IMREAD_GRAYSCALE
    ) -> Iterator[Shaped[np.ndarray, "h w"]]:
        """Yield frames first .. stop - 1, of 8 bits, or as many as they have (ALL_BITS).

        Raises ValueError for one that cannot be read, is of another size or kind than the first,
        or has floats outside [0, 1].
        """
        if self.index is not None:
            yield from self.index.read(first, stop, self.config_key, flags == ALL_BITS)
        size, kind = self.size, None
        for path in self.frames[first:stop]:
            picture = read_picture(path, flags)
            if picture is None:
                raise ValueError(f"{self.config_key} must hold frames that can be read, got {path}")
            size = size or picture.shape
            if picture.shape != size:
                wanted, (height, width) = f"{size[1]}x{size[0]} px", picture.shape
                raise ValueError(
                    f"{self.config_key} must hold frames of {wanted}, "
                    f"got {width}x{height} in {path}"
                )
            kind = kind or picture.dtype
            if picture.dtype != kind:
                wanted = f"{self.config_key} must hold frames of one kind"
                raise ValueError(f"{wanted}, got {kind} and {picture.dtype} in {path}")
            check_float_values(picture, self.config_key, path)
            yield picture


def find_videos(root: Path, config_key: str = "scene.root") -> list[VideoSource]:
    """Return the videos at `root` by name.

    Raises ValueError, which names `config_key`, where there are none.
    """
    if root.is_file():
        return [_file_source(root, config_key)]
    entries = sorted(path for path in root.iterdir() if path.name[0] != ".")
    files = [path for path in entries if path.suffix.lower() in VIDEO_SUFFIXES]
    videos = _folder_sources(root, config_key)
    if not videos:
        with ThreadPoolExecutor() as pool:  # each file is decoded once
            videos = list(pool.map(partial(_file_source, config_key=config_key), files))
        videos += [
            one for path in entries if path.is_dir() for one in _folder_sources(path, config_key)
        ]
    if not videos:
        raise ValueError(f"{config_key} must hold videos or folders of frames, got none in {root}")
    return videos


def walk_files(folder: Path, around: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Yield the files below a folder, and below folders that it links to, but none whose name or
    folder's name begins with a dot.  `around`: the folders walked into so far; a link to one of
    these, or to what holds one, is not followed.
    """
    here = folder.resolve()
    if any(one.is_relative_to(here) for one in around):
        return
    with os.scandir(folder) as entries:
        shown = [entry for entry in entries if entry.name[0] != "."]
    for entry in shown:
        if entry.is_dir():
            yield from walk_files(folder / entry.name, (*around, here))
        elif entry.is_file():
            yield folder / entry.name


def sort_naturally(paths: Iterable[Path]) -> list[Path]:
    """Return paths in natural order of their names, numbers by value: 2.png before 10.png."""
    return sorted(
        paths,
        key=lambda path: [
            int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name)
        ],
    )


def _folder_sources(path: Path, config_key: str) -> list[VideoSource]:
    """Return the folder as one video, none where no frames are in it."""
    names = sort_naturally(path.iterdir())
    frames = [p for p in names if p.suffix.lower() in PICTURE_SUFFIXES and p.name[0] != "."]
    return [VideoSource(path.name, len(frames), config_key, frames=tuple(frames))] if frames else []


def _file_source(path: Path, config_key: str) -> VideoSource:
    from src.sim.scenes.video_index import index_video  # PyAV: not where only pictures are read

    index = index_video(path, config_key)
    count = len(index.constant_rate_frames)
    if count < 2:
        raise ValueError(
            f"{config_key} must be a video of two frames or more, got {count} in {path}"
        )
    return VideoSource(path.stem, count, config_key, index=index)


def is_photograph(path: Path) -> bool:
    """Return whether a path is a picture: by its name, or a file that is no video by its name, or
    a GIF of one frame, and that OpenCV reads.
    """
    suffix = path.suffix.lower()
    if suffix in PICTURE_SUFFIXES | VIDEO_SUFFIXES - {".gif"} or not path.is_file():
        return suffix in PICTURE_SUFFIXES
    is_picture = read_picture(path) is not None
    return is_picture and (suffix != ".gif" or cv2.imcount(str(path)) == 1)


def read_picture(source: Path | bytes, flags: int = cv2.IMREAD_GRAYSCALE) -> NDArray | None:
    """Return the picture (h, w) of a file or of its bytes, or None where it is none, is cut short
    or has too many pixels (video_decoding.LARGEST_PIXELS), as a small file could unpack to
    gigabytes.
    """
    if is_cut_jpeg(source):
        return None
    try:
        if isinstance(source, bytes):
            return cv2.imdecode(np.frombuffer(source, np.uint8), flags)
        return cv2.imread(str(source), flags)
    except cv2.error:
        return None


def is_cut_jpeg(source: Path | bytes) -> bool:
    """Return whether a file, or its bytes, is a JPEG without the marker of its end (ISO/IEC
    10918-1, B.1.1.3), of which OpenCV fills the rest with grey.  Bytes may follow the marker.
    """
    if isinstance(source, Path):
        try:
            with source.open("rb") as file:
                source = start + file.read() if (start := file.read(2)) == JPEG_START else b""
        except OSError:
            return False
    place = len(JPEG_START)
    if not source.startswith(JPEG_START):
        return False
    # Up to the first scan: segments of a stated length, in which a thumbnail may have its own end.
    while source[place : place + 1] == b"\xff" and source[place + 1 : place + 2] != JPEG_SCAN:
        is_fill = source[place + 1 : place + 2] == b"\xff"
        place += 1 if is_fill else 2 + int.from_bytes(source[place + 2 : place + 4], "big")
    return source.find(JPEG_END, place) < 0
