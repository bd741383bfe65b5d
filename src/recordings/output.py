"""Frames to a file as they come: MP4, GIF, PNG or HDF5, with a table of their time stamps; films of
panels; and a video of one's own frames (`write_video`).

Every format keeps what was written when the run is stopped, and holds one frame at a time.  Until
the end files have `partial` in their names, so that none that is cut short is taken for whole.
"""

import csv
import os
import re
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain, count, pairwise
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
from jaxtyping import Float, UInt8
from PIL import GifImagePlugin, Image

from src.recordings.files.event_file import HeightWidth
from src.recordings.reconstruction import Frame
from src.records.atomic import atomic_path, check_free_space, name_path_in_errors, partial_path
from src.sim.checks import check_in_range
from src.sim.user_values import read_array, read_path

VP9 = {"crf": "12", "b": "0", "deadline": "realtime", "cpu-used": "6"}  # error of 1 level, rms
KEY_FRAME_EVERY = 12
CACHE_BYTES = 2**20  # of HDF5, for each of its datasets
MAX_GIF_FPS = 50  # a frame of less than two hundredths of a second is shown for ten
FRAME_NAME = re.compile(r"\d{7,}\.png$")
Picture = UInt8[np.ndarray, "h w *rgb"]  # grey, or of three colours
Add = Callable[[Picture, Frame | None], None]


@contextmanager
def open_video_writer(
    kind: str, folder: Path, size: HeightWidth, playback_fps: float = 30.0
) -> Iterator[Callable[[Frame], None]]:
    """Open `video.mp4`, `video.gif`, `frames/`, `video.h5` or `film.mp4` in `folder`; yield
    `write(frame)`.

    `size`: (height, width); `film`: frames with colours; `playback_fps`: of an MP4 or GIF,
    in [0.1, 1000], of a GIF up to 50.
    `frames.csv` gets each frame's index, time in s, events in views and outside of them.  Raises
    ValueError as `check_video_settings` does, or where the file cannot be written.
    """
    check_video_settings(kind, folder, playback_fps)
    folder.mkdir(parents=True, exist_ok=True)
    make, whole = KINDS[kind]
    video, table_file = partial_path(folder / whole), partial_path(folder / "frames.csv")
    with (
        name_path_in_errors(folder / whole),
        open(table_file, "w", newline="") as file,
        make(video, size, playback_fps) as add,
    ):
        table = csv.writer(file)
        table.writerow(["frame", "time_s", "events", "events_outside_views"])
        frames = 0

        def write(frame: Frame) -> None:
            nonlocal frames
            check_free_space(folder)
            add(round_to_uint8(frame.picture), frame)
            table.writerow([frames, f"{frame.time_s:.6f}", frame.events, frame.events_outside])
            frames += 1

        yield write
    if whole.endswith(".mp4"):
        _check_mp4(video, frames)
    if (folder / whole).is_dir():
        shutil.rmtree(folder / whole)  # frames of an earlier run into the same folder
    os.replace(video, folder / whole)
    os.replace(table_file, folder / "frames.csv")


def check_video_settings(kind: str, folder: Path, playback_fps: float) -> None:
    """Raise ValueError for what `open_video_writer` cannot open: another `kind`, a `playback_fps`
    out of range, or a `frames/` in `folder` with other files than frames."""
    if kind not in KINDS:
        raise ValueError(f"output_format must be one of {', '.join(KINDS)}, got {kind}")
    highest, whose = (MAX_GIF_FPS, " for output_format=gif") if kind == "gif" else (1000, "")
    if not 0.1 <= playback_fps <= highest:
        allowed = f"[0.1, {highest}]{whose}"
        raise ValueError(f"playback_fps must be in {allowed}, got {playback_fps}")
    _check_only_frames(folder / KINDS[kind][1])


def write_video(path: Path | str, frames: Iterable[np.ndarray], fps: float) -> int:
    """Write frames (h, w), grey, or (h, w, 3), RGB, floats in [0, 1] or uint8, as an MP4 (VP9);
    return how many.

    The file is there when it is whole.  Raises ValueError for another ending of `path`, no frames,
    frames of several sizes or with a mask, floats outside [-0.5, 1.5] (what is beyond [0, 1] is
    clipped), other types and an `fps` outside [0.1, 1000].
    """
    path, given = read_path("path", path), (read_array("frames", frame) for frame in frames)
    first = next(given, None)
    if path.suffix != ".mp4":
        raise ValueError(f"path must end in .mp4, got {path}")
    if isinstance(fps, str):
        raise ValueError(f"fps must be a number, got {fps!r}")
    check_in_range("fps", fps, 0.1, 1000)
    if first is None or first.ndim not in (2, 3) or first.shape[2:] not in ((), (3,)):
        shape = "none" if first is None else first.shape
        raise ValueError(f"frames must be of shape (h, w) or (h, w, 3), got {shape}")
    count = 0
    with atomic_path(path) as partial:
        with _mp4(partial, first.shape[:2], fps) as add:
            for frame in chain([first], given):
                if frame.shape != first.shape:
                    raise ValueError(f"frames must be of one size {first.shape}, got {frame.shape}")
                _check_values(frame)
                add(round_to_uint8(frame), None)
                count += 1
        _check_mp4(partial, count)
    return count


def _check_values(frame: np.ndarray) -> None:
    low, high = frame.min(initial=0), frame.max(initial=0)
    is_code = frame.dtype.kind == "f" and np.isfinite([low, high]).all()
    if frame.dtype != np.uint8 and not (is_code and low >= -0.5 and high <= 1.5):
        got = f"{frame.dtype} from {low} to {high}"
        raise ValueError(f"frames must be uint8 or floats in [-0.5, 1.5], got {got}")


def round_to_uint8(picture: np.ndarray) -> UInt8[np.ndarray, "*shape"]:
    """Return code values, floats in [0, 1] or uint8, as uint8."""
    if picture.dtype == np.uint8:
        return picture
    return (np.clip(picture, 0, 1) * 255 + 0.5).astype(np.uint8)


def write_png(path: Path, picture: Picture) -> None:
    """Write a picture as a PNG; raises OSError where that fails, as on a full disk."""
    if not cv2.imwrite(str(path), picture):
        raise OSError(f"{path} cannot be written; is the disk full?")


def resize_picture(
    picture: Float[np.ndarray, "h w"], size: tuple[int, ...]
) -> Float[np.ndarray, "h2 w2"]:
    """Return a grey picture of `size` (h2, w2): shrunk by means over areas, enlarged by cubic
    interpolation, which may leave its range of values.
    """
    how = cv2.INTER_AREA if size[0] <= picture.shape[0] else cv2.INTER_CUBIC  # areas leave blocks
    return cv2.resize(picture, (size[1], size[0]), interpolation=how)


def _check_only_frames(folder: Path) -> None:
    """Raise ValueError for a folder, to be replaced, of other files than frames."""
    others = folder.is_dir() and [p for p in folder.iterdir() if not FRAME_NAME.match(p.name)]
    if others:
        more = f"{min(others)} is there already"
        raise ValueError(f"output_format=png needs a folder frames/ of its own, {more}")


def _check_mp4(path: Path, written: int) -> None:
    """Raise OSError unless `written` frames are in it: an encoder may be silent on a full disk."""
    with av.open(str(path)) as file:
        frames = file.streams.video[0].frames if file.streams.video else 0
    if frames != written:
        raise OSError(f"{path} holds {frames} of {written} frames; is the disk full?")


@contextmanager
def _mp4(path: Path, size: HeightWidth, fps: float) -> Iterator[Add]:
    rate = Fraction(fps).limit_denominator(1001)
    with av.open(str(path), "w", format="mp4") as file:
        stream = file.add_stream("libvpx-vp9", rate=rate, options=VP9)  # browsers and OpenCV know
        stream.height, stream.width = size  # odd ones too
        stream.pix_fmt = "yuv420p"
        stream.codec_context.gop_size = KEY_FRAME_EVERY
        file.start_encoding()
        numbers = count()

        def add(picture: Picture, frame: Frame | None) -> None:
            form = "gray" if picture.ndim == 2 else "rgb24"
            image = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format=form)
            image.pts = next(numbers)
            file.mux(stream.encode(image))

        try:
            yield add
        finally:
            file.mux(stream.encode())


def iter_frame_durations(fps: float, ticks_per_s: int) -> Iterator[int]:
    """Yield the ticks that frame after frame is shown: whole, and `fps` frames a second in the
    mean (of 30 in hundredths of a second 3, 4, 3, 3, ...)."""
    ends = (int(ticks_per_s * frame / fps + 0.5) for frame in count())
    return (end - start for start, end in pairwise(ends))


@contextmanager
def _gif(path: Path, size: HeightWidth, fps: float) -> Iterator[Add]:
    hundredths = iter_frame_durations(fps, 100)
    with open(path, "wb") as file:
        blank = Image.new("L", size[::-1])
        file.write(b"".join(GifImagePlugin.getheader(blank, info={"loop": 0})[0]))

        def add(picture: Picture, frame: Frame | None) -> None:
            image = Image.fromarray(picture)
            file.write(b"".join(GifImagePlugin.getdata(image, duration=10 * next(hundredths))))

        try:
            yield add
        finally:
            file.write(b";")


@contextmanager
def _png(path: Path, size: HeightWidth, fps: float) -> Iterator[Add]:
    if path.is_dir():
        shutil.rmtree(path)  # what a stopped run left
    path.mkdir()
    names = (path / f"{number:07d}.png" for number in count())

    def add(picture: Picture, frame: Frame | None) -> None:
        write_png(next(names), picture)

    yield add


@contextmanager
def _hdf5(path: Path, size: HeightWidth, fps: float) -> Iterator[Add]:
    with h5py.File(path, "w", rdcc_nbytes=CACHE_BYTES) as file:
        shapes = {"maxshape": (None, *size), "chunks": (1, *size)}
        frames = file.create_dataset("frames", (0, *size), np.uint8, compression="lzf", **shapes)
        times = file.create_dataset("time_s", (0,), np.float64, maxshape=(None,), chunks=(4096,))

        def add(picture: Picture, frame: Frame | None) -> None:
            assert frame is not None
            for data, value in ((frames, picture), (times, frame.time_s)):
                data.resize(len(data) + 1, axis=0)
                data[-1] = value

        yield add


KINDS = {
    "mp4": (_mp4, "video.mp4"),
    "gif": (_gif, "video.gif"),
    "png": (_png, "frames"),
    "hdf5": (_hdf5, "video.h5"),
    "film": (_mp4, "film.mp4"),
}
