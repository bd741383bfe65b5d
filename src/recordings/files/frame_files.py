"""Frames of a camera beside the event pixels, as files hold them."""

import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from src.recordings.files.event_file import RawFrames
from src.sim.scenes.video_files import PICTURE_SUFFIXES, read_picture, sort_naturally

PICTURE_FOLDERS = ("images_corrected", "images")  # of TimeLens's recordings, beside the events
TIME_FILES = ("timestamp.txt", "timestamps.txt")


def find_listed_frames(listing: Path) -> RawFrames | None:
    """Return the pictures of a text file with a line for each, seconds and file; None where there
    is no such file (images.txt of the Event Camera Dataset)."""
    if not listing.is_file():
        return None
    rows = read_frame_list(listing)
    return _pictures([path for _, path in rows], np.array([second for second, _ in rows]), "s")


def read_frame_list(listing: Path, config_key: str | None = None) -> list[tuple[float, Path]]:
    """Return the seconds and the picture in each line of a text file, but for blank lines and
    comments (#); raises ValueError, which names the file or `config_key`, for another line."""
    lines = map(str.strip, listing.read_text().splitlines())
    rows = [line.split(maxsplit=1) for line in lines if line and line[0] != "#"]
    try:
        return [(float(second), listing.parent / name) for second, name in rows]
    except ValueError:
        wanted = f"{config_key or listing} must have seconds and a file in each line"
        raise ValueError(f"{wanted}, {listing} has not" if config_key else wanted) from None


def find_timelens_frames(events_folder: Path) -> RawFrames | None:
    """Return the pictures of TimeLens's layout, in a folder beside that of the events: in order of
    name, with a line of timestamp.txt for each, in the events' unit of time."""
    found = [p for name in PICTURE_FOLDERS if (p := events_folder.parent / name).is_dir()]
    if not found:
        return None
    names = list_pictures(found[0])
    places = [place / name for place in (found[0], events_folder.parent) for name in TIME_FILES]
    listing = next((place for place in places if place.is_file()), None)
    if listing is None:
        warnings.warn(
            f"{found[0]}: {len(names)} frames without timestamp.txt, left out", stacklevel=2
        )
        return None
    try:
        times = np.loadtxt(listing, ndmin=1)
    except ValueError as error:
        raise ValueError(f"{listing} must have a time in each line: {error}") from error
    if times.shape != (len(names),):
        raise ValueError(f"{listing} has {times.size} times for {len(names)} pictures")
    return _pictures(names, times, None)


def list_pictures(folder: Path) -> list[Path]:
    """Return the pictures in a folder in natural order of their names, hidden files left out."""
    pictures = (path for path in folder.iterdir() if path.suffix.lower() in PICTURE_SUFFIXES)
    return sort_naturally(path for path in pictures if path.name[0] != ".")


def wrap_frame_array(pictures: Any, times: np.ndarray, unit: str | None = None) -> RawFrames:
    """Return the frames of an array (n, h, w) or (n, h, w, 1), which are read one by one."""
    if pictures.ndim not in (3, 4) or len(pictures) != len(times):
        raise ValueError(f"{len(times)} times for frames of shape {pictures.shape}")
    height, width = pictures.shape[1:3]

    def one_by_one() -> Iterator[np.ndarray]:
        yield from (to_gray(np.asarray(pictures[k])) for k in range(len(times)))

    return RawFrames(np.asarray(times), (height, width), one_by_one, unit)


def to_gray(picture: np.ndarray, rgb: bool = False) -> np.ndarray:
    """Return a picture (h, w), (h, w, 1) or in colour (h, w, 3), BGR unless `rgb`, as (h, w)."""
    if picture.ndim == 3 and picture.shape[2] == 3:
        return cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY if rgb else cv2.COLOR_BGR2GRAY)
    return picture[..., 0] if picture.ndim == 3 else picture


def _pictures(names: Sequence[Path], times: np.ndarray, unit: str | None) -> RawFrames | None:
    if not names:
        return None
    height, width = _read(names[0]).shape
    return RawFrames(times, (height, width), lambda: map(_read, names), unit)


def _read(path: Path) -> np.ndarray:
    picture = read_picture(path, cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise ValueError(f"{path} must be a picture that can be read")
    return picture
