"""Your own video or photograph as a clean clip: all of it, uncropped, at its own rate.

Grey values are luminance code values.  Pictures are only shrunk, with an area filter.
"""

import math
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.checks import check_in_range
from src.sim.scenes.code_values import (
    ALL_BITS,
    check_float_values,
    scale_to_white,
    warn_of_darkness,
    warn_of_transparency,
)
from src.sim.scenes.moving_layers import (
    FASTEST_WIDTHS_PER_S,
    MovingLayer,
    SimilarityMotion,
    render_frame,
)
from src.sim.scenes.video_files import VideoSource, find_videos, read_picture
from src.sim.user_values import read_array

LARGEST_SIDE_PX = 512  # of the frames, where nothing else is asked for
LEAST_SIDE_PX = 16
PHOTO_FPS, PHOTO_S = 120.0, 1.0  # where nothing else is asked for


@dataclass(frozen=True, eq=False)
class UserClip:
    """`frames` (frames, h, w), 16 or 32 bit floats in [0, 1], code values, at `fps`; `source`: what
    the material is, in words.
    """

    name: str
    frames: Float[np.ndarray, "frames h w"]
    fps: float
    source: str

    @property
    def size(self) -> tuple[int, int]:
        """Height and width, pixels."""
        return self.frames.shape[1], self.frames.shape[2]

    def interpolate_frames(
        self, first_substep: int, stop_substep: int, substeps: int
    ) -> Float[Tensor, "count h w"]:
        """Return frames first_substep .. stop_substep - 1 of the clip at `substeps` times its rate,
        float32: linear blends between two frames.
        """
        before, rest = np.divmod(np.arange(first_substep, stop_substep), substeps)
        share = (rest / substeps).astype(np.float32)[:, None, None]
        one, next_one = (
            self.frames[np.minimum(at, len(self.frames) - 1)].astype(np.float32)
            for at in (before, before + 1)
        )
        return torch.from_numpy(one + share * (next_one - one))


def read_video(
    path: Path | str, *, fps: float | None = None, start_s: float = 0.0, end_s: float = math.inf,
    longest_side_px: int | None = None, white_level: float | None = None,
) -> UserClip:  # fmt: skip
    """Return a video file, or a folder of frames, from `start_s` to `end_s`.

    `fps`: that it is taken for (None: as the file says); `longest_side_px` of its frames (None:
    their own, at most LARGEST_SIDE_PX); `white_level`: value of frames that is white (None: the
    largest their type holds).  Raises ValueError for what is no video, says no rate, or has less
    than two frames there.
    """
    source = _find_one_video(Path(path))
    rate = source.index.fps if fps is None and source.index else fps
    if rate is None:
        raise ValueError(f"fps must be given, frames a second, for {path}, which states none")
    _check_rate(rate)
    first, stop = _find_part(source.count, rate, start_s, end_s, str(path))
    frames, shape, largest, kind = [], (0, 0), 0.0, np.dtype(np.uint8)
    for picture in source.read(first, stop, ALL_BITS):
        shape, kind, largest = picture.shape, picture.dtype, max(largest, float(picture.max()))
        if white_level is not None and source.index and kind == np.uint8:
            wanted = "white_level must be null for a video file of 8 bits or of colour"
            raise ValueError(f"{wanted}, got {white_level}")
        values = scale_to_white(picture, white_level)
        frames.append(_shrink(values, longest_side_px).astype(np.float16))
    warn_of_darkness(path, kind, largest, white_level)
    if source.frames:
        warn_of_transparency(source.frames[first])
    part = "all" if stop - first == source.count else f"frames {first} to {stop - 1}"
    facts = f"{shape[1]}x{shape[0]} px, {rate:.6g} frames/s, {part} of {source.count} frames"
    return UserClip(source.name, np.stack(frames), rate, facts)


def _find_part(count: int, fps: float, start_s: Any, end_s: Any, name: str) -> tuple[int, int]:
    """Return the first frame from `start_s` on, and the first from `end_s` on, of `count`."""
    are_numbers = isinstance(start_s, Real) and isinstance(end_s, Real)
    if not (are_numbers and 0 <= start_s < end_s):
        raise ValueError(f"start_s must be >= 0 and below end_s, got {start_s} and {end_s}")
    first = math.ceil(round(start_s * fps, 6))
    stop = count if end_s == math.inf else min(count, math.ceil(round(end_s * fps, 6)))
    if stop - first < 2:
        lasts = f"{count / fps:.3f} s"
        raise ValueError(f"start_s and end_s must leave two frames or more of {name}, {lasts} long")
    return first, stop


def refuse_part_of_photograph(start_s: float, end_s: float) -> None:
    """Raise ValueError for a part of a video where there is a photograph."""
    if (start_s, end_s) != (0.0, math.inf):
        got = f"{start_s} and {end_s}"
        raise ValueError(f"start_s and end_s are of a video, a photograph has seconds; got {got}")


def refuse_motion_of_video(seconds: float | None, speed_widths_per_s: float) -> None:
    """Raise ValueError for the length or the motion of a photograph where there is a video."""
    if seconds is not None:
        way = "a video has start_s and end_s"
        raise ValueError(f"seconds must be left out but for a photograph, {way}; got {seconds}")
    if speed_widths_per_s:
        only = "speed_widths_per_s must be 0 but for a photograph"
        raise ValueError(f"{only}, got {speed_widths_per_s}")


def read_photograph(
    path: Path | str, *, fps: float | None = None, seconds: float | None = None,
    longest_side_px: int | None = None, white_level: float | None = None,
    speed_widths_per_s: float = 0.0, seed: int = 0,
) -> UserClip:  # fmt: skip
    """Return a photograph for `seconds` (None: 1) at `fps` (None: 120): at rest, or in a smooth
    motion, drawn from `seed`: its middle moves by 0.67 of `speed_widths_per_s`, frame widths a
    second, in the mean, and it turns and zooms whatever the speed (`SimilarityMotion`).
    `white_level` as in `read_video`.

    Raises ValueError for what is no picture and for values outside their range.
    """
    picture = read_picture(Path(path), ALL_BITS) if Path(path).is_file() else None
    if picture is None:
        raise ValueError(f"photo must be a picture that can be read (a film: video=), got {path}")
    check_float_values(picture, "photo", path)
    warn_of_transparency(Path(path))
    facts = f"photograph of {picture.shape[1]}x{picture.shape[0]} px"
    values = _shrink(scale_to_white(picture, white_level), longest_side_px)
    fps = PHOTO_FPS if fps is None else fps
    frames = _hold_or_move(values, fps, seconds, speed_widths_per_s, seed)
    warn_of_darkness(path, picture.dtype, float(picture.max()), white_level)
    return UserClip(Path(path).stem, frames, fps, facts)


def clip_from_array(
    values: Any, *, fps: float | None = None, seconds: float | None = None, start_s: float = 0.0,
    end_s: float = math.inf, longest_side_px: int | None = None, white_level: float | None = None,
    speed_widths_per_s: float = 0.0, seed: int = 0,
) -> UserClip:  # fmt: skip
    """Return an array as a clip: (h, w), a photograph, or (frames, h, w), a video at `fps`, of
    uint8 or of floats in [0, 1].  `start_s`, `end_s` and `white_level` as in `read_video`,
    `seconds`, `speed_widths_per_s` and `seed` as in `read_photograph`.

    Raises ValueError for another shape, a mask, values outside, a video without `fps` and for what
    is of the other kind.
    """
    array = read_array("photo_or_video", values)
    is_colour = array.ndim == 3 and array.shape[2] <= 4
    if array.ndim not in (2, 3) or is_colour or (array.ndim == 3 and len(array) < 2):
        wanted = "(h, w), a photograph, or (frames, h, w), two frames or more, grey"
        raise ValueError(f"photo_or_video must be of shape {wanted}, got {array.shape}")
    if array.dtype != np.uint8 and not (
        array.dtype.kind == "f" and array.size and 0 <= array.min() <= array.max() <= 1
    ):
        got = str(array.dtype)
        if array.dtype.kind == "f" and array.size:
            got = f"{got} from {array.min():g} to {array.max():g}"
        raise ValueError(f"photo_or_video must be uint8 or floats in [0, 1], got {got}")
    facts = "x".join(map(str, array.shape[:-3:-1])) + " px"
    array = scale_to_white(array, white_level)
    if array.ndim == 2:
        refuse_part_of_photograph(start_s, end_s)
        fps = PHOTO_FPS if fps is None else fps
        values = _shrink(array, longest_side_px)
        frames = _hold_or_move(values, fps, seconds, speed_widths_per_s, seed)
        return UserClip("photograph", frames, fps, facts)
    refuse_motion_of_video(seconds, speed_widths_per_s)
    if fps is None:
        raise ValueError("fps must be given for an array of frames, frames a second")
    _check_rate(fps)
    first, stop = _find_part(len(array), fps, start_s, end_s, "the array")
    frames = np.stack([_shrink(frame, longest_side_px) for frame in array[first:stop]])
    return UserClip("video", frames, fps, f"{facts}, {fps:.6g} frames/s, {len(frames)} frames")


def _find_one_video(path: Path) -> VideoSource:
    if not path.exists():
        raise ValueError(f"video must be a file or a folder of frames that exists, got {path}")
    try:
        videos = find_videos(path, "video")
    except ValueError as error:
        is_picture = path.is_file() and read_picture(path) is not None
        raise ValueError(f"{error}{'; a photograph is photo=' * is_picture}") from None
    if len(videos) != 1:
        raise ValueError(f"video must be one video or one folder of frames, got {path}")
    if videos[0].count < 2:  # a folder: files are looked at before
        raise ValueError(f"video must be a folder of two frames or more, got one in {path}")
    return videos[0]


def _check_rate(fps: Any) -> None:
    if not (isinstance(fps, int | float) and 0.1 <= fps <= 1e6):
        raise ValueError(f"fps must be in [0.1, 1e6] frames a second, got {fps}")


def _hold_or_move(
    picture: NDArray, fps: float, seconds: float | None, speed: float, seed: int
) -> Float[np.ndarray, "frames h w"]:
    """Return the frames of a picture for `seconds` at `fps`, at `speed` widths a second."""
    _check_rate(fps)
    seconds = PHOTO_S if seconds is None else seconds
    check_in_range("speed_widths_per_s", speed, 0, FASTEST_WIDTHS_PER_S)
    check_in_range("seconds", seconds, 2 / fps, 1e6)  # two frames or more
    count = round(seconds * fps) + 1
    if speed:
        return _move(picture, count, fps, speed, seed)
    return np.broadcast_to(picture, (count, *picture.shape))


def _shrink(values: Float[np.ndarray, "h w"], longest_side_px: int | None) -> NDArray:
    """Return values at most `longest_side_px` long."""
    wanted = LARGEST_SIDE_PX if longest_side_px is None else longest_side_px
    if not (isinstance(wanted, int) and wanted >= LEAST_SIDE_PX):
        raise ValueError(f"longest_side_px must be >= {LEAST_SIDE_PX} or null, got {wanted}")
    shrink = min(1.0, wanted / max(values.shape))
    size = [round(side * shrink) for side in values.shape]
    if min(size) < LEAST_SIDE_PX:
        got = f"{size[1]}x{size[0]}"
        raise ValueError(f"frames must be {LEAST_SIDE_PX} px or more on either side, got {got}")
    if shrink < 1:
        values = cv2.resize(values, size[::-1], interpolation=cv2.INTER_AREA)
    return np.clip(values, 0, 1)


def _move(
    picture: NDArray, count: int, fps: float, speed: float, seed: int
) -> Float[np.ndarray, "count h w"]:
    rng = np.random.default_rng(noise.key(seed, "motion of a photograph"))
    motion = SimilarityMotion(rng, (speed, speed))
    motion.angle = 0.0  # upright at the start
    centre = np.array([(side - 1) / 2 for side in picture.shape[::-1]])
    layer = MovingLayer(picture, None, centre, 1.0, motion)
    return np.stack([render_frame([layer], k / fps, picture.shape) for k in range(count)])
