"""Videos as OpenCV reads them: a file, a folder of frames, or a folder of these; grey, 8 bits."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
from numpy.typing import NDArray

from src.sim.scenes.photo_files import SUFFIXES
from src.sim.scenes.pictures import open_video, read_picture

FILES = {".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv"}


@dataclass(frozen=True)
class Source:
    """One video: its `name`, how many frames, and `read(first, stop)`, which yields those, uint8
    (h, w), and raises ValueError for one that is missing or of another size than the first.
    """

    name: str
    count: int
    read: Callable[[int, int], Iterator[NDArray]]


def sources(root: Path, key: str = "scene.root") -> list[Source]:
    """Return the videos at `root` by name.

    Raises ValueError, which names `key`, where there are none.
    """
    if root.is_file():
        return [_file(root, key)]
    entries = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    inside = [path for path in entries if path.is_dir()]
    videos = _folder(root, key) or [
        *(_file(path, key) for path in entries if path.suffix.lower() in FILES),
        *(source for path in inside for source in _folder(path, key)),
    ]
    if not videos:
        raise ValueError(f"{key} must hold videos or folders of frames, got none in {root}")
    return videos


def pictures(
    name: str, paths: list[Path], size: tuple[int, int] | None = None, key: str = "scene.root"
) -> Source:
    """Return the video whose frames are `paths`, of `size` (h, w) or as large as the first."""
    return Source(name, len(paths), partial(_read_pictures, paths, size, key))


def _folder(path: Path, key: str) -> list[Source]:
    frames = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.name[0] != ".")
    return [pictures(path.name, frames, key=key)] if frames else []


def _file(path: Path, key: str) -> Source:
    video = open_video(path, key)
    count = int(video.get(cv2.CAP_PROP_FRAME_COUNT))
    video.release()
    if count < 2:
        raise ValueError(f"{key} must be a video of two frames or more, got {path}")
    return Source(path.stem, count, partial(_read_file, path, key))


def _read_pictures(
    paths: list[Path], size: tuple[int, int] | None, key: str, first: int, stop: int
) -> Iterator[NDArray]:
    for path in paths[first:stop]:
        picture = read_picture(path)
        if picture is None:
            raise ValueError(f"{key} must hold frames that can be read, got {path}")
        size = size or picture.shape
        if picture.shape != size:
            height, width = picture.shape
            raise ValueError(
                f"{key} must hold frames of {size[1]}x{size[0]} px, got {width}x{height} in {path}"
            )
        yield picture


def _read_file(path: Path, key: str, first: int, stop: int) -> Iterator[NDArray]:
    video = open_video(path, key)
    video.set(cv2.CAP_PROP_POS_FRAMES, first)
    for number in range(first, stop):
        there, picture = video.read()
        if not there:
            raise ValueError(f"{key} must be readable throughout, got {path} at {number}")
        yield cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    video.release()
