"""Picture and video files, read by OpenCV."""

import math
import os
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

LARGEST_PIXELS = int(os.environ["OPENCV_IO_MAX_IMAGE_PIXELS"])  # src/__init__.py sets 2^27


def read_picture(path: Path, flags: int = cv2.IMREAD_GRAYSCALE) -> NDArray | None:
    """Return the picture (h, w), or None for a file that is none or has more than
    LARGEST_PIXELS, as a small file could unpack to gigabytes.
    """
    try:
        return cv2.imread(str(path), flags)
    except cv2.error:
        return None


def decode_picture(data: bytes) -> NDArray | None:
    """Return the luminance (h, w), uint8, of an encoded picture; None as `read_picture` does."""
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    except cv2.error:
        return None


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
