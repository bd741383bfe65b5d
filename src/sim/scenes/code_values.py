"""From the values of a picture's file to code values in [0, 1]."""

import warnings
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

ALL_BITS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH  # of OpenCV: grey, as deep as the file is
DARK_SHARE = 1 / 8  # of full scale: a picture below this has data of fewer bits than its file


def scale_to_white(
    values: NDArray, white_level: float | None = None, key: str = "white_level"
) -> Float[np.ndarray, "*shape"]:
    """Return values of a file as float32 in [0, 1]: 1 is `white_level`, or the largest value of
    their type, 1 of floats.  Raises ValueError, which names `key`, for a `white_level` that is not
    in (0, that].
    """
    full = _largest_value(values.dtype)
    white = full if white_level is None else white_level
    if not (isinstance(white, int | float) and 0 < white <= full):
        raise ValueError(f"{key} must be in (0, {full:g}] or null, got {white_level}")
    return np.clip(values.astype(np.float32) / white, 0, 1)


def warn_of_darkness(
    path: Path | str, kind: np.dtype, largest: float, white_level: float | None,
    key: str | None = "white_level",
) -> None:  # fmt: skip
    """Warn of values of more than 8 bits that are nearly black, as those of 12 bits are in 16.
    `key`: the config key of `white_level`, None where there is none."""
    full = _largest_value(kind)
    if white_level is None and kind.itemsize > 1 and 0 < largest < DARK_SHARE * full:
        white = 2 ** int(largest).bit_length() - 1  # the least number of bits that holds it
        way = (
            f"{key}={white} makes {white} white"
            if key
            else f"times {full / white:.0f} it fills the range"
        )
        way = f"; {way}" if full > 1 else ""
        warnings.warn(f"{path}: its largest value is {largest:g} of {full:g}{way}", stacklevel=3)


def check_float_values(picture: NDArray, key: str, path: Path | str) -> None:
    """Raise ValueError, which names `key`, for a picture of floats that are not in [0, 1]."""
    if picture.dtype.kind != "f":
        return
    low, high = picture.min(), picture.max()
    if not 0 <= low <= high <= 1:
        got = f"{low:g} to {high:g} in {path}"
        raise ValueError(f"{key} must hold whole numbers or floats in [0, 1], got {got}")


def warn_of_transparency(path: Path) -> None:
    """Warn of a PNG or WebP with transparent pixels: their hidden colours are read."""
    with path.open("rb") as file:
        header = file.read(26)
    # The kind of colour: a palette, grey or colour with an opacity (PNG, 11.2.2); the flag of
    # opacity, of a WebP with extras or without loss (RFC 9649, 2.7 and 3.4).
    is_png = header[:4] == b"\x89PNG" and header[25] in (3, 4, 6)
    place = {b"VP8X": 20, b"VP8L": 24}.get(header[12:16])
    is_webp = header[8:12] == b"WEBP" and place is not None and header[place] & 0x10
    if is_png or is_webp:
        picture = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if picture is None or picture.shape[2:] != (4,):
            return
        if picture[..., 3].min() < _largest_value(picture.dtype):
            way = "lay the picture on a ground of one colour"
            warnings.warn(f"{path}: transparent pixels show hidden colours; {way}", stacklevel=3)


def _largest_value(kind: np.dtype) -> float:
    return float(np.iinfo(kind).max) if kind.kind in "iu" else 1.0
