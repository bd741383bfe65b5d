"""The frames of a recording, in order of time on the clock of its events."""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from src.recordings.files.event_file import UNITS_US, HeightWidth, RawFrames, name_file_in_errors
from src.recordings.files.recording import EventRecording


@dataclass(frozen=True)
class RecordedFrames:
    """Frames at `times_us`, microseconds on the events' clock, ascending; `size`: (height, width);
    `pictures()` yields them, uint8 (h, w), one after the other."""

    times_us: Float[np.ndarray, " n"]
    size: HeightWidth
    pictures: Callable[[], Iterator[np.ndarray]]

    def select(self, mask: Bool[np.ndarray, " n"]) -> "RecordedFrames":
        """Return the frames where `mask` is true."""
        pictures = self.pictures
        return replace(
            self, times_us=self.times_us[mask], pictures=lambda: compress(pictures(), mask)
        )


def find_frames(recording: EventRecording) -> RecordedFrames | None:
    """Return the frames that a recording has beside its events; None where it has none.

    A time before that of the frame before is replaced by the mean of its neighbours', with a
    warning (as EVREAL does: HQF has one).  Raises ValueError, which names the file, for frames that
    cannot be read or whose times do not ascend even then.
    """
    path = recording.path
    with name_file_in_errors(path, "its frames cannot be read"):
        raw = recording.file.frames()
    if raw is None or not len(raw.t):
        return None
    times = np.array(raw.t, np.float64).ravel() * UNITS_US[raw.unit or recording.survey.unit]
    return RecordedFrames(_ascending(times, path), raw.size, lambda: _checked(raw, path))


def _ascending(times: np.ndarray, path: Path) -> np.ndarray:
    wrong = np.flatnonzero(times[1:-1] < times[:-2]) + 1
    if len(wrong):
        warnings.warn(
            f"{path}: {len(wrong)} frames earlier than the one before, put between", stacklevel=2
        )
        times[wrong] = (times[wrong - 1] + times[wrong + 1]) / 2
    if not (np.diff(times) >= 0).all():
        raise ValueError(f"{path}: the times of its frames must ascend")
    return times


def _checked(raw: RawFrames, path: Path) -> Iterator[np.ndarray]:
    count = 0
    for count, picture in enumerate(raw.pictures(), 1):
        if picture.shape != raw.size or picture.dtype != np.uint8:
            (height, width), got = raw.size, "x".join(map(str, picture.shape[::-1]))
            wanted = f"must have 8 bits and {width}x{height} pixels, as the first"
            raise ValueError(f"{path}: frame {count} {wanted}, got {got} of {picture.dtype}")
        yield picture
    if count != len(raw.t):
        raise ValueError(f"{path}: {len(raw.t)} times of frames, but {count} frames")
