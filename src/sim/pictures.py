"""Picture files, read by OpenCV."""

import os
from pathlib import Path

import cv2
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
