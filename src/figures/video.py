"""Moving pictures: panels side by side with their names, events in colour, GIF and PNG files."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from src.records.atomic import written

TITLE_PX = 18  # height of the strip with a panel's name
GAP_PX = 4
SMALLEST_PX = 160  # panels lower than this are enlarged by a whole factor

Video = Float[np.ndarray, "_frames _h _w 3"]


def event_picture(
    counts: Float[np.ndarray, "frames h w"], full: float = 3.0
) -> Float[np.ndarray, "frames h w 3"]:
    """Return sums of polarity as colours on white: ON blue, OFF red, solid from `full` events."""
    strength = np.clip(np.abs(counts) / full, 0, 1)[..., None]
    ink = np.where(counts[..., None] > 0, (0.1, 0.3, 0.9), (0.9, 0.15, 0.1))
    return (1 - strength * (1 - ink)).astype(np.float32)


def row(panels: dict[str, Video]) -> Video:
    """Return the panels side by side, equally high, each under its name; white between them.

    All have the same number of frames; heights differ by whole factors.
    """
    tallest = max(max(video.shape[1] for video in panels.values()), SMALLEST_PX)
    columns = [
        _titled(enlarged(video, tallest // video.shape[1]), n) for n, video in panels.items()
    ]
    height = max(column.shape[1] for column in columns)
    below = [(0, height - column.shape[1]) for column in columns]
    columns = [
        np.pad(column, ((0, 0), rows, (0, GAP_PX), (0, 0)), constant_values=1)
        for column, rows in zip(columns, below, strict=True)
    ]
    return np.concatenate(columns, axis=2)[:, :, :-GAP_PX]


def write_video(path: Path, frames: Video, fps: float) -> None:
    """Write a GIF (or, of the first frame, what else the suffix says) whole or not at all.

    Values are clipped to [0, 1]; GIFs keep time to hundredths of a second.
    """
    eight = (np.clip(frames, 0, 1) * 255 + 0.5).astype(np.uint8)
    pictures = [Image.fromarray(frame) for frame in eight]
    with written(path) as partial:
        if path.suffix == ".gif":
            first, *rest = (p.quantize(128, dither=Image.Dither.NONE) for p in pictures)
            time = {"duration": 1000 / fps, "loop": 0}
            first.save(partial, "GIF", save_all=True, append_images=rest, **time)
        else:
            pictures[0].save(partial, Image.registered_extensions()[path.suffix])


def _titled(video: Video, name: str) -> Video:
    strip = np.full((TITLE_PX, video.shape[2], 3), 255, np.uint8)
    font, place = cv2.FONT_HERSHEY_SIMPLEX, (3, TITLE_PX - 5)
    strip = cv2.putText(strip, name, place, font, 0.42, (0, 0, 0), 1, cv2.LINE_AA) / 255
    above = np.broadcast_to(strip.astype(np.float32), (len(video), *strip.shape))
    return np.concatenate([above, video], axis=1)


def enlarged(video: Video, factor: int) -> Video:
    """Return a video whose pixels are repeated `factor` times along both axes."""
    return video.repeat(factor, axis=1).repeat(factor, axis=2) if factor > 1 else video
