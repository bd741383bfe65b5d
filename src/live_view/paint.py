"""Pictures for the page: events in two colours, views side by side, JPEG and PNG."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Int, UInt8

QUALITY, DOTS = 88, 80  # of JPEG; events in colour are dots, which need less and cost most
SMALL = 264  # longer side in pixels of all views side by side, which take turns with the rest
GROUND = (24, 21, 19)  # blue, green, red
OFF, ON = (255, 150, 70), (90, 190, 255)
STRONG = 2  # events at a pixel that are drawn at full colour
Positions = Sequence[tuple[int, int]]


def _colours() -> UInt8[np.ndarray, "256 1 3"]:
    """Return the colours of -STRONG ... STRONG events, the first ones."""
    share = np.abs(np.linspace(-1, 1, 2 * STRONG + 1))[:, None] ** 0.6
    ends = np.array([OFF] * STRONG + [GROUND] + [ON] * STRONG)
    table = np.zeros((256, 1, 3), np.uint8)  # as applyColorMap wants it
    table[: len(ends), 0] = share * ends + (1 - share) * np.array(GROUND)
    return table


COLOURS = _colours()


def events(counts: Int[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w 3"]:
    """Return polarities added up at each pixel in colour (blue, green, red): ON warm, OFF cool."""
    steps = (np.clip(counts, -STRONG, STRONG) + STRONG).astype(np.uint8)
    return cv2.applyColorMap(steps, COLOURS)


def side_by_side(
    counts: Int[np.ndarray, "views h w"], positions: Positions
) -> UInt8[np.ndarray, "rows columns 3"]:
    """Return the events of all views where they stand in the light field, made small."""
    rows, columns = (sorted({place[axis] for place in positions}) for axis in (0, 1))
    _, height, width = counts.shape
    whole = np.zeros((len(rows) * height, len(columns) * width), counts.dtype)
    for view, (row, column) in zip(counts, positions, strict=True):
        top, left = rows.index(row) * height, columns.index(column) * width
        whole[top : top + height, left : left + width] = view
    shrink = max(1, -(-max(whole.shape) // SMALL))
    kept = whole[: whole.shape[0] // shrink * shrink, : whole.shape[1] // shrink * shrink]
    blocks = kept.reshape(kept.shape[0] // shrink, shrink, kept.shape[1] // shrink, shrink)
    return events(blocks.sum((1, 3)))


def jpeg(picture: UInt8[np.ndarray, "..."]) -> bytes:
    """Return a grey or colour picture as JPEG, colours at full resolution."""
    full = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444
    quality = QUALITY if picture.ndim == 2 else DOTS
    how = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, full]
    return cv2.imencode(".jpg", picture, how)[1].tobytes()


def png(picture: UInt8[np.ndarray, "..."]) -> bytes:
    """Return a picture as PNG."""
    return cv2.imencode(".png", picture)[1].tobytes()
