"""Moving pictures: panels side by side with their names, events in colour, GIF and PNG files."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image

from src.records.atomic import atomic_path

TITLE_PX = 18  # height of the strip with a panel's name
GAP_PX = 4
MIN_HEIGHT_PX = 160  # lower panels are enlarged by a whole factor

Video = Float[np.ndarray, "_frames _h _w *_rgb"]


def render_events(
    counts: Float[np.ndarray, "frames h w"], full: float = 3.0
) -> Float[np.ndarray, "frames h w 3"]:
    """Return sums of polarity as colours on white: ON blue, OFF red, solid from `full` events."""
    strength = np.clip(np.abs(counts) / full, 0, 1)[..., None]
    ink = np.where(counts[..., None] > 0, (0.1, 0.3, 0.9), (0.9, 0.15, 0.1))
    return (1 - strength * (1 - ink)).astype(np.float32)


def join_panels(panels: dict[str, Video]) -> Video:
    """Return the panels side by side, equally high, each under its name; white between them.

    All have the same number of frames; heights differ by whole factors; grey ones have no colours.
    """
    tallest = max(MIN_HEIGHT_PX, *(video.shape[1] for video in panels.values()))
    columns = []
    for name, video in panels.items():
        factor = max(tallest // video.shape[1], 1)
        video = video.repeat(factor, axis=1).repeat(factor, axis=2)
        video = video if video.ndim == 4 else np.repeat(video[..., None], 3, axis=-1)
        strip = np.full((TITLE_PX, video.shape[2], 3), 255, np.uint8)
        font, place = cv2.FONT_HERSHEY_SIMPLEX, (3, TITLE_PX - 5)
        drawn = cv2.putText(strip, name, place, font, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
        above = np.broadcast_to((drawn / 255).astype(np.float32), (len(video), *strip.shape))
        columns.append(np.concatenate([above, video], axis=1))
    height = max(column.shape[1] for column in columns)
    columns = [
        np.pad(c, ((0, 0), (0, height - c.shape[1]), (0, GAP_PX), (0, 0)), constant_values=1)
        for c in columns
    ]
    return np.concatenate(columns, axis=2)[:, :, :-GAP_PX]


def write_video(path: Path, frames: Video, fps: float) -> None:
    """Write a GIF (or, of the first frame, what else the suffix says) whole or not at all.

    Values are clipped to [0, 1]; GIFs keep time to hundredths of a second.
    """
    eight = (np.clip(frames, 0, 1) * 255 + 0.5).astype(np.uint8)
    pictures = [Image.fromarray(frame) for frame in eight]
    with atomic_path(path) as partial:
        if path.suffix == ".gif":
            first, *rest = (p.quantize(128, dither=Image.Dither.NONE) for p in pictures)
            time = {"duration": 1000 / fps, "loop": 0}
            first.save(partial, "GIF", save_all=True, append_images=rest, **time)
        else:
            pictures[0].save(partial, Image.registered_extensions()[path.suffix])
