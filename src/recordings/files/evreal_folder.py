"""EVREAL's layout (Ercan et al. 2023): a folder of .npy for a sequence of events and frames.

    events_ts.npy (n,) float64 seconds     images.npy (m, h, w, 1) uint8
    events_xy.npy (n, 2)                   images_ts.npy (m, 1) float64 seconds
    events_p.npy (n,) 0 or 1               image_event_indices.npy (m, 1)
    metadata.json {"sensor_resolution": [height, width]}

The clock starts at 0 with the first event or frame.  An index is that of the last event at or
before a frame, 0 where there is none.
"""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from src.recordings.files.event_file import (
    EventFile,
    HeightWidth,
    RawEvents,
    RawFrames,
    ReadOptions,
    name_file_in_errors,
)
from src.recordings.files.frame_files import wrap_frame_array
from src.recordings.files.lazy_columns import slice_columns, slice_times

EVENT_FILES = ("events_ts.npy", "events_xy.npy", "events_p.npy")
FRAME_FILES = ("images.npy", "images_ts.npy", "image_event_indices.npy")
OLDER_FILES = ("t.npy", "xy.npy", "p.npy")  # of event_utils, from which the layout comes


@dataclass(frozen=True)
class EvrealSequence:
    """The arrays of a folder, read from the disk where they are used.

    Events: `t` (n,) in seconds, `xy` (n, 2), `p` (n,); frames: `images` (m, h, w, 1), `frame_t`
    (m,) in seconds, `last_event_index` (m,), all None for events alone.  `size`: (height, width).
    """

    path: Path
    t: np.ndarray
    xy: np.ndarray
    p: np.ndarray
    size: HeightWidth
    images: np.ndarray | None = None
    frame_t: np.ndarray | None = None
    last_event_index: np.ndarray | None = None


def is_evreal_folder(path: Path) -> bool:
    """Return whether a folder has a file of EVREAL's layout or of the one before."""
    return any((path / name).is_file() for name in (*EVENT_FILES, *FRAME_FILES, *OLDER_FILES))


def open_sequence(path: Path) -> EvrealSequence:
    """Return the sequence of a folder.

    Raises ValueError, which begins with the path, for a file that is missing or cannot be read,
    shapes, types and lengths other than those of the layout, and a folder without events.
    """
    names = [name for name in FRAME_FILES if (path / name).is_file()]
    if not any((path / name).is_file() for name in EVENT_FILES) and (path / "t.npy").is_file():
        older, known = ", ".join(OLDER_FILES), ", ".join(EVENT_FILES)
        raise ValueError(f"{path}: {older} are another version of the layout, read are {known}")
    arrays = [_load(path / name) for name in (*EVENT_FILES, *(FRAME_FILES if names else ()))]
    t, xy, p, *frames = arrays
    t, p = t.reshape(-1), p.reshape(-1)
    if t.dtype.kind != "f":
        raise ValueError(f"{path}: events_ts.npy must hold seconds as float64, got {t.dtype}")
    if xy.ndim != 2 or xy.shape[1] != 2 or xy.dtype.kind not in "iu":
        wanted = "must be (n, 2) of whole numbers"
        raise ValueError(f"{path}: events_xy.npy {wanted}, got {xy.shape} of {xy.dtype}")
    _check_lengths(path, EVENT_FILES, (t, xy, p))
    if not len(t):
        raise ValueError(f"{path}: holds no events")
    if not frames:
        return EvrealSequence(path, t, xy, p, _size(path, xy, None))
    images, frame_t, index = frames
    frame_t, index = np.array(frame_t, np.float64).reshape(-1), np.array(index).reshape(-1)
    _check_frames(path, images, index, len(t))
    _check_lengths(path, FRAME_FILES, (images, frame_t, index))
    return EvrealSequence(path, t, xy, p, _size(path, xy, images), images, frame_t, index)


class EvrealFolder(EventFile):
    """A folder of EVREAL's layout as a recording."""

    time_unit = "s"

    def __init__(self, path: Path, options: ReadOptions):
        self.path, self._held = path, open_sequence(path)
        self.size = self._held.size[::-1]

    def pieces(self) -> Iterator[RawEvents]:
        t, p, (x, y) = self._held.t, self._held.p, self._held.xy.T
        yield from slice_columns(self.path, {"t": t, "x": x, "y": y, "p": p}, self.kept_times)

    def times(self) -> Iterator[np.ndarray]:
        yield from slice_times(self.path, self._held.t)

    def frames(self) -> RawFrames | None:
        images, times = self._held.images, self._held.frame_t
        return None if images is None or times is None else wrap_frame_array(images, times)


def _load(path: Path) -> np.ndarray:
    if not path.is_file():
        raise ValueError(f"{path.parent}: {path.name} is missing")
    with name_file_in_errors(path, "cannot be read as an array"):
        return np.load(path, mmap_mode="r")


def _check_lengths(path: Path, names: tuple[str, ...], arrays: tuple[np.ndarray, ...]) -> None:
    lengths = {name: len(array) for name, array in zip(names, arrays, strict=True)}
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{count} in {name}" for name, count in lengths.items())
        raise ValueError(f"{path}: lengths must be the same, got {listed}")


def _check_frames(path: Path, images: np.ndarray, index: np.ndarray, events: int) -> None:
    if images.ndim != 4 or images.dtype != np.uint8:
        got = f"{images.shape} of {images.dtype}"
        raise ValueError(f"{path}: images.npy must be (m, h, w, 1) of uint8, got {got}")
    is_valid = index.dtype.kind in "iu" and ((index >= 0) & (index <= events)).all()
    if not is_valid:
        wanted = f"hold numbers of events, 0..{events}"
        raise ValueError(f"{path}: image_event_indices.npy must {wanted}, got {index[:3]}...")


def _size(path: Path, xy: np.ndarray, images: np.ndarray | None) -> HeightWidth:
    """Return (height, width) as metadata.json states it, else that of the frames or events."""
    shown = None if images is None else images.shape[1:3]
    file = path / "metadata.json"
    if file.is_file():
        try:
            height, width = map(int, json.loads(file.read_text())["sensor_resolution"])
        except (ValueError, KeyError, TypeError) as error:
            wanted = '{"sensor_resolution": [height, width]}'
            raise ValueError(f"{file} must be {wanted}, got another: {error}") from error
    else:
        height, width = shown or (int(xy[:, 1].max()) + 1, int(xy[:, 0].max()) + 1)
    if shown not in (None, (height, width)):
        raise ValueError(f"{path}: frames are {shown}, metadata.json states {(height, width)}")
    return height, width
