"""Frames of a video file, decoded with FFmpeg (PyAV) up to its first fault; grey as OpenCV's."""

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.video.reformatter import Interpolation, VideoReformatter
from jaxtyping import UInt
from numpy.typing import NDArray

LARGEST_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])  # src/__init__.py sets 2^27
Gray = UInt[np.ndarray, "h w"]  # uint8, or uint16 where that is asked for


class DamagedVideo(Exception):
    """The frames after this place of a file cannot be read."""


@contextmanager
def open_video(path: Path, config_key: str) -> Iterator[tuple[Any, Any]]:
    """Open the first video stream of a file; raises ValueError, which names `config_key`."""
    wanted = f"{config_key} must be a video that FFmpeg can read"
    refusal = f"{wanted}, with frames of at most {LARGEST_PIXELS} pixels, got {path}"
    options = {"protocol_whitelist": "file"}  # a playlist may not fetch from elsewhere
    try:
        container = av.open(f"file:{path}", options=options, metadata_errors="replace")
    except (av.FFmpegError, ValueError, OSError) as error:
        raise ValueError(refusal) from error
    with container:
        stream: Any = container.streams.best("video")
        decoder = stream.codec_context if stream else None  # none for an unknown codec
        is_text = container.format.name == "tty"  # FFmpeg draws the letters
        if is_text or decoder is None or not 0 < decoder.width * decoder.height <= LARGEST_PIXELS:
            raise ValueError(refusal)
        yield container, stream


def decode_frames(container: Any, stream: Any) -> Iterator[Any]:
    """Yield the frames in the order in which they are shown; what cannot be decoded before the
    first is left out.  Raises DamagedVideo at the first fault after it.
    """
    some = False
    try:
        for packet in container.demux(stream):
            frames, fault = _decode_packet(packet)
            for frame in frames:
                if frame.is_corrupt and some:
                    raise DamagedVideo("a frame has errors")
                if not frame.is_corrupt:
                    some = True
                    yield frame
            if fault and some:
                raise DamagedVideo(fault)
    except av.FFmpegError as error:
        raise DamagedVideo(error.strerror) from error


def _decode_packet(packet: Any) -> tuple[list, str]:
    """Return the frames that come out, and why none do."""
    if packet.is_corrupt:
        return [], "a part is incomplete"
    try:
        return packet.decode(), ""
    except av.FFmpegError as error:
        return [], str(error.strerror)


def convert_to_gray(frames: Iterable[Any], all_bits: bool = False) -> Iterator[Gray]:
    """Yield grey pictures, uint8 (h, w), upright, as OpenCV makes them: by way of BGR; with
    `all_bits` those of grey frames of more than 8 bits as uint16, full scale 65535.
    """
    convert = VideoReformatter().reformat  # one for all frames keeps its tables
    for frame in frames:
        if all_bits and frame.format.name.startswith("gray") and frame.format.bits_per_pixel > 8:
            gray: NDArray = convert(frame, format="gray16le").to_ndarray()
        else:
            bgr = convert(frame, format="bgr24", interpolation=Interpolation.BICUBIC)
            gray = cv2.cvtColor(bgr.to_ndarray(), cv2.COLOR_BGR2GRAY)
        yield _turn_upright(gray, frame.side_data.get("DISPLAYMATRIX"), frame.rotation)


def _turn_upright(picture: NDArray, display_matrix: Any, rotation: float) -> NDArray:
    """Return a picture as the display matrix of its file says, turned by right angles or mirrored;
    as it is stored without one and at other angles.
    """
    if display_matrix is None or round(rotation) % 90:
        return picture
    # ISO 14496-12: x is shown at (a x, b x), y at (c y, d y).
    (a, b, _), (c, d, _), _ = np.frombuffer(display_matrix, np.int32).reshape(3, 3).tolist()
    if abs(b) > abs(a):
        picture, a, d = picture.T, c, b
    return np.ascontiguousarray(picture[:: -1 if d < 0 else 1, :: -1 if a < 0 else 1])
