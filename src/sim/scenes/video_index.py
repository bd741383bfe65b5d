"""Which frames a video file shows and when; any of them by its number.

Headers are not believed: edit lists hide frames, browsers write no duration, phones vary the rate.
A file is decoded once for its index, which stays in memory; then any frame is reached from the key
frame before it.  Grey values of 8 bits are those of OpenCV's own reader.
"""

import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, islice
from pathlib import Path
from typing import Any

import av
import numpy as np
from jaxtyping import Int
from numpy.typing import NDArray

from src.sim.scenes.video_decoding import (
    DamagedVideo,
    Gray,
    convert_to_gray,
    decode_frames,
    open_video,
)

MAX_FPS = 1e7  # that is believed
MOST_FRAMES = 10**7  # of a video that is brought to a constant rate
UNEVEN = 0.25  # deviation of an interval from the median, over it, beyond which the rate varies
REORDERED = 16  # frames that a codec stores out of order, at most
RATE_ERROR = 0.01  # of the rate that a file states; else it is measured


@dataclass(frozen=True, eq=False)
class VideoIndex:
    """The frames of a video file.

    `times_ticks`: of its whole frames, in ticks of the file, none where it has no usable ones;
    `keyframes`: their numbers.  `constant_rate_frames`: the number of the whole frame that each
    frame of the video at the constant rate `fps` (None: unknown) shows.  `notes`: what is warned of
    whenever the file is opened.
    """

    path: Path
    times_ticks: Int[np.ndarray, " frames"]
    keyframes: Int[np.ndarray, " keys"]
    constant_rate_frames: Int[np.ndarray, " count"]
    fps: float | None
    notes: tuple[str, ...] = ()

    def read(
        self, first: int, stop: int, config_key: str, all_bits: bool = False
    ) -> Iterator[Gray]:
        """Yield frames first .. stop - 1, uint8, with `all_bits` uint16 where grey ones have more
        bits; raises ValueError, which names `config_key`, for a
        file that is another one by now.
        """
        wanted = self.constant_rate_frames[first:stop]
        if not len(wanted):
            return
        frames = self._read_whole(int(wanted[0]), config_key, all_bits)
        number, frame = int(wanted[0]), next(frames)
        for target in wanted:
            while number < target:
                number, frame = number + 1, next(frames)
            yield frame

    def _read_whole(self, first: int, config_key: str, all_bits: bool) -> Iterator[Gray]:
        """Yield the whole frames from `first` on, by way of the key frame before it."""
        before = self.keyframes[self.keyframes <= first].tolist() if len(self.times_ticks) else []
        for start in dict.fromkeys([*before[-1:], 0]):
            with open_video(self.path, config_key) as (container, stream):
                frames = self._enter(container, stream, start, first)
                if frames is not None:
                    with suppress(DamagedVideo):
                        yield from convert_to_gray(frames, all_bits)
                    break
        raise ValueError(f"{config_key} must not change while it is read, got {self.path}")

    def _enter(self, container: Any, stream: Any, start: int, first: int) -> Iterator[Any] | None:
        """Return the frames from `first` on, decoded from the key frame `start` on; None where the
        file cannot be entered there.
        """
        frames = decode_frames(container, stream)
        if start == 0:
            return islice(frames, first, None)
        try:
            container.seek(int(self.times_ticks[start]), stream=stream)
            found = next(frame for frame in frames if frame.pts >= self.times_ticks[start])
            for number in range(start, first):
                if found.pts != self.times_ticks[number]:
                    return None
                found = next(frames)
        except (av.FFmpegError, DamagedVideo, StopIteration, TypeError):
            return None
        return chain([found], frames) if found.pts == self.times_ticks[first] else None


def index_video(path: Path, config_key: str, max_frames: int | None = None) -> VideoIndex:
    """Return the index of a video file, of its first `max_frames` frames (None: all).

    Warns of a file that is cut or damaged, whose frames before that place count, and of a variable
    frame rate.  Raises ValueError, which names `config_key`, for a file that is no video, shows no
    whole frame, or has frames of several sizes or of more than LARGEST_PIXELS.
    """
    try:
        state = path.stat()
    except OSError as error:
        raise ValueError(f"{config_key} must be a video that exists, got {path}") from error
    index = _index(path, config_key, max_frames, state.st_mtime_ns, state.st_size)
    for note in index.notes:
        warnings.warn(note, stacklevel=1)  # one place, so that Python tells it once a process
    return index


@lru_cache(maxsize=4096)
def _index(path: Path, config_key: str, max_frames: int | None, *version: int) -> VideoIndex:
    with open_video(path, config_key) as (container, stream):
        times, keys, fault = _list_frames(container, stream, path, config_key, max_frames)
        known = None not in times and bool(np.all(np.diff(np.array(times, float)) > 0))
        ticks, count = np.array(times if known else [], np.int64), len(times)
        shown, fps, uneven = _at_constant_rate(ticks, count, stream)
        if not fault and max_frames is None and _ends_early(ticks, count, fps, container, stream):
            fault = "it ends before its stated end"
            ticks = ticks[: _find_hole_at_end(ticks)]
            count = len(ticks) or count
            shown, fps, uneven = _at_constant_rate(ticks, count, stream)
        if fault and container.format.name == "avi":  # its time stamps count chunks
            keys = []
    if len(shown) > MOST_FRAMES:
        raise ValueError(
            f"{config_key} must show at most {MOST_FRAMES} frames, got more by the time stamps of "
            f"{path}"
        )
    notes = []
    if fault:
        notes += [f"{path} is cut or damaged ({fault}): its first {count} frames are read"]
    if uneven:
        note = f"{path} has a variable frame rate: its {count} frames are brought to "
        notes += [f"{note}{fps:.6g} frames/s by their time stamps"]
    return VideoIndex(path, ticks, np.array(keys, np.int64), shown, fps, tuple(notes))


def _list_frames(
    container: Any, stream: Any, path: Path, config_key: str, max_frames: int | None
) -> tuple[list[int | None], list[int], str]:
    """Return the time stamps of the whole frames, the numbers of key frames and what ends them."""
    times: list[int | None] = []
    keys: list[int] = []
    sizes: set[tuple[int, int]] = set()
    fault = ""
    try:
        for frame in islice(decode_frames(container, stream), max_frames):
            if frame.key_frame:
                keys.append(len(times))
            times.append(frame.pts)
            sizes.add((frame.width, frame.height))
    except DamagedVideo as error:
        fault = str(error)
    if not times:
        raise ValueError(f"{config_key} must be a video with a whole frame, got none in {path}")
    if len(sizes) > 1:
        raise ValueError(
            f"{config_key} must have frames of one size, got {sorted(sizes)} in {path}"
        )
    return times, keys, fault


def _find_hole_at_end(ticks: NDArray[np.int64]) -> int:
    """Return how many frames come before a hole among the last: a frame that is stored before the
    ones shown earlier.
    """
    gaps = np.diff(ticks)
    if not len(gaps):
        return len(ticks)
    holes = np.flatnonzero(gaps[-REORDERED:] > 1.5 * np.median(gaps))
    return len(gaps[:-REORDERED]) + int(holes[0]) + 1 if len(holes) else len(ticks)


def _at_constant_rate(
    ticks: NDArray[np.int64], count: int, stream: Any
) -> tuple[NDArray[np.int64], float | None, bool]:
    """Return which of `count` frames is shown in each interval of a constant rate, the rate, and
    whether that changed anything.  The rate of uneven frames is one over their median interval.
    """
    rate = next((float(r) for r in (stream.average_rate, stream.guessed_rate) if r), None)
    rate = rate if rate is not None and 0 < rate < MAX_FPS else None
    everything = np.arange(count)
    if len(ticks) < 2:
        return everything, rate, False
    tick_s, gaps = float(stream.time_base), np.diff(ticks)
    middle, mean = float(np.median(gaps)), (ticks[-1] - ticks[0]) / (count - 1)
    drift = np.abs(ticks - ticks[0] - mean * everything).max()
    # One tick more or less is rounding.
    is_even = np.abs(gaps - middle).max() <= max(UNEVEN * middle, 1) and drift <= max(mean / 2, 1)
    if is_even:
        measured = float(1 / (mean * tick_s))
        believed = rate is not None and abs(rate / measured - 1) <= RATE_ERROR
        return everything, rate if believed else measured, False
    length = int((ticks[-1] - ticks[0]) / middle + 0.5) + 1
    if length > MOST_FRAMES:
        return np.zeros(MOST_FRAMES + 1, np.int64), None, True
    wanted = ticks[0] + middle * np.arange(length)
    shown = np.searchsorted((ticks[1:] + ticks[:-1]) / 2, wanted, side="right")  # the nearest
    return shown, 1 / (middle * tick_s), True


def _ends_early(
    ticks: NDArray[np.int64], count: int, fps: float | None, container: Any, stream: Any
) -> bool:
    """Return whether a file states that its video, edit lists regarded, lasts longer than it does
    (a last frame may be shown for two intervals).
    """
    if not fps:
        return False
    if container.format.name == "avi":
        return bool(stream.frames > max(count, ticks[-1] - ticks[0] + 1 if len(ticks) else 0))
    stated = stream.duration * stream.time_base if stream.duration else 0
    if not stated and len(container.streams) == 1 and container.duration:
        stated = container.duration / av.time_base
    end = ticks[-1] * stream.time_base if len(ticks) else (count - 1) / fps
    return bool(float(stated) - float(end) > max(2.5 / fps, 0.1))
