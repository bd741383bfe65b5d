"""Pictures of a run: films of panels side by side (GIF, PNG), space-time slices, and the views."""

from collections.abc import Iterable
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from src.figures.comparison import VideoRow, draw_comparison
from src.recordings.output import iter_frame_durations, resize_picture, round_to_uint8
from src.records.atomic import atomic_path
from src.sim.optics import Optics, layout, most_central_view_index
from src.sim.pipeline import Sample

PLAYBACK_FPS = 15.0
TITLE_PX = 18  # height of the strip with a panel's name
GAP_PX = 4
MAX_VIEW_PX, MAX_VIEWS_PX = 160, 240  # longest side in views.gif of a view, of all side by side
WEBP_QUALITY = 70
MIN_HEIGHT_PX = 160  # lower panels are enlarged by a whole factor

Video = Float[np.ndarray, "_frames _h _w *_rgb"]


def write_samples(folder: Path, clips: Iterable[tuple[Sample, Tensor]]) -> list[Path]:
    """Write `clip<i>.gif` (clean, centre view, events, reconstruction) and `clip<i>_slice.png`
    (x-t slices of the middle row) of clip i, a sample and its reconstruction (as `sample.target`);
    return the paths.
    """
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for index, (sample, frames) in enumerate(clips):
        parts = {"clean": sample.target, "centre view": sample.turbulent}
        parts["reconstruction"] = frames.float().clamp(0, 1)
        videos = {name: part[0, :, 0].cpu().numpy() for name, part in parts.items()}
        gif, slices = folder / f"clip{index}.gif", folder / f"clip{index}_slice.png"
        positions = sample.positions or layout(sample.voxels.shape[2])
        centre = most_central_view_index(positions)
        counts = sample.voxels[0, :, centre].sum(1).cpu().numpy()
        window_s = float(sample.window_s[0])
        events = {title_events(window_s): render_events(counts)}
        events["reconstruction"] = videos["reconstruction"]
        first = {name: videos[name] for name in ("clean", "centre view")}
        write_animation(gif, join_panels(first | events), PLAYBACK_FPS)
        _, height, width = videos["clean"].shape
        line = np.array([[0, height // 2], [width - 1, height // 2]], dtype=float)
        rows = [VideoRow(name, video, video[:, height // 2]) for name, video in videos.items()]
        draw_comparison(rows, slices, line=line, frame_s=window_s)
        paths += [gif, slices]
    return paths


def write_light_field_panels(
    folder: Path, clean: Video, views: Float[np.ndarray, "views windows h w"],
    tilt: Float[np.ndarray, "views windows 2 h w"],
    counts: Float[np.ndarray, "views windows h w"], optics: Optics, window_s: float,
) -> list[Path]:  # fmt: skip
    """Write `views.gif` and its last frame `views.png`: the clean clip, and of every view its
    light, in [0, 1], its tilt and its sums of polarity over a window of `window_s` seconds, in the
    arrangement of the views; pictures longer than MAX_VIEW_PX, or all together than MAX_VIEWS_PX,
    shrunk to that, sums to those of largest magnitude.

    Of `tilt`, in pixels, that in x is drawn: red where the picture is pushed right, blue where
    left.  The clean clip is as high as all views together.
    """
    across = max(max(places) - min(places) + 1 for places in zip(*optics.positions, strict=True))
    longest_px = min(MAX_VIEW_PX, MAX_VIEWS_PX // across)
    views, tilt = (_shrink(pictures, longest_px) for pictures in (views, tilt))
    counts = shrink_events(counts, longest_px)
    seen = place_views_at_apertures(list(views), optics)
    events = [render_events(part) for part in counts]
    reach = max(float(np.abs(tilt).max()), 1e-6)
    pushed = [render_events(part[:, 0], full=reach) for part in tilt]
    panels = {
        "clean": resize_pictures(clean, seen.shape[1]),
        "views": seen,
        f"tilt in x, +-{reach:.1f} px": place_views_at_apertures(pushed, optics),
        title_events(window_s): place_views_at_apertures(events, optics),
    }
    frames = join_panels(panels)
    paths = [folder / "views.gif", folder / "views.png"]
    write_animation(paths[0], frames, PLAYBACK_FPS)
    write_animation(paths[1], frames[-1:], PLAYBACK_FPS)
    return paths


def _shrink(
    pictures: Float[np.ndarray, "*n h w"], longest_px: int
) -> Float[np.ndarray, "*n h2 w2"]:
    """Return pictures at most `longest_px` long, by means over areas."""
    *shape, height, width = pictures.shape
    shrink = longest_px / max(height, width)
    if shrink >= 1:
        return pictures
    small = resize_pictures(pictures.reshape(-1, height, width), max(1, round(height * shrink)))
    return small.reshape(*shape, *small.shape[1:])


def shrink_events(
    counts: Float[np.ndarray, "*n h w"], longest_px: int = MAX_VIEW_PX
) -> Float[np.ndarray, "*n h2 w2"]:
    """Return sums of polarity at most `longest_px` long: of each area the one of largest magnitude,
    as in a mean single events would fade."""
    most = least = counts
    height, width = counts.shape[-2:]
    shrink = min(1.0, longest_px / max(height, width))
    height_px = max(1, round(height * shrink))
    sizes = {-2: height_px, -1: max(1, round(width * height_px / height))}  # as resize_pictures
    for axis, small in sizes.items():
        length = counts.shape[axis]
        starts = np.arange(small) * length // small
        most = np.maximum.reduceat(most, starts, axis)
        least = np.minimum.reduceat(least, starts, axis)
    return np.where(most >= -least, most, least)


def resize_pictures(
    pictures: Float[np.ndarray, "n h w"], height_px: int
) -> Float[np.ndarray, "n height_px w2"]:
    """Return grey pictures `height_px` high, in proportion: shrunk by means over areas, enlarged by
    cubic interpolation, which keeps their range of values."""
    _, height, width = pictures.shape
    size = height_px, max(1, round(width * height_px / height))
    resized = np.stack([resize_picture(one, size) for one in pictures])
    return resized.clip(pictures.min(), pictures.max())


def place_views_at_apertures(videos: list[Video], optics: Optics) -> Video:
    """Place the videos of the views where their apertures are; gaps are white."""
    rows, columns = zip(*optics.positions, strict=True)
    frames, height, width, *rgb = videos[0].shape
    size = ((max(rows) - min(rows) + 1) * height, (max(columns) - min(columns) + 1) * width)
    canvas = np.ones((frames, *size, *rgb), np.float32)
    for row, column, video in zip(rows, columns, videos, strict=True):
        top, left = (row - min(rows)) * height, (column - min(columns)) * width
        canvas[:, top : top + height, left : left + width] = video
    return canvas


def title_events(seconds: float) -> str:
    """Return the title of a panel of the events of so many seconds."""
    return f"events of {1e3 * seconds:.3g} ms: brighter red, darker blue"


def render_events(
    counts: Float[np.ndarray, "frames h w"], full: float = 3.0
) -> Float[np.ndarray, "frames h w 3"]:
    """Return sums of polarity as colours on white: ON, brighter, red and OFF, darker, blue, solid
    from `full` events."""
    strength = np.clip(np.abs(counts) / full, 0, 1)[..., None]
    ink = np.where(counts[..., None] > 0, (0.9, 0.15, 0.1), (0.1, 0.3, 0.9))
    return (1 - strength * (1 - ink)).astype(np.float32)


def join_panels(panels: dict[str, Video]) -> Video:
    """Return the panels side by side, equally high, each under its name; white between them.

    All have the same number of frames; heights differ by whole factors.  Grey ones, (frames, h, w),
    are interpolated where they are enlarged; of those with colours, events, pixels are repeated.
    """
    tallest = max(MIN_HEIGHT_PX, *(video.shape[1] for video in panels.values()))
    columns = []
    for name, video in panels.items():
        factor = max(tallest // video.shape[1], 1)
        if video.ndim == 3:
            large = resize_pictures(video, factor * video.shape[1]) if factor > 1 else video
            video = np.repeat(large[..., None], 3, axis=-1)
        else:
            video = video.repeat(factor, axis=1).repeat(factor, axis=2)
        strip = _draw_title(name, video.shape[2])
        above = np.broadcast_to(strip, (len(video), *strip.shape))
        columns.append(np.concatenate([above, video], axis=1))
    height = max(column.shape[1] for column in columns)
    columns = [
        np.pad(c, ((0, 0), (0, height - c.shape[1]), (0, GAP_PX), (0, 0)), constant_values=1)
        for c in columns
    ]
    return np.concatenate(columns, axis=2)[:, :, :-GAP_PX]


def _draw_title(name: str, width: int) -> Float[np.ndarray, "title_px width 3"]:
    """Return the strip above a panel; of a name too long for it only what is before the colon."""
    font, black = (cv2.FONT_HERSHEY_SIMPLEX, 0.42), (0, 0, 0)
    fits = cv2.getTextSize(name, *font, 1)[0][0] + 3 <= width
    strip = np.full((TITLE_PX, width, 3), 255, np.uint8)
    text, place = name if fits else name.partition(":")[0], (3, TITLE_PX - 5)
    drawn = cv2.putText(strip, text, place, *font, black, 1, cv2.LINE_AA)
    return (drawn / 255).astype(np.float32)


def write_animation(path: Path, frames: Video, fps: float) -> None:
    """Write a GIF or WebP (or, of the first frame, what else the suffix says) whole or not at all.

    Values are clipped to [0, 1].  GIFs keep time to hundredths of a second, WebP to thousandths, in
    both `fps` is the mean; players show frames of a GIF above 50 a second slower.
    """
    pictures, kind = list(map(Image.fromarray, round_to_uint8(frames))), path.suffix[1:].upper()
    options: dict[str, Any] = {}
    if kind == "GIF":
        pictures = [picture.quantize(128, dither=Image.Dither.NONE) for picture in pictures]
        hundredths = islice(iter_frame_durations(fps, 100), len(pictures))
        options = {"duration": [10 * one for one in hundredths]}
    elif kind == "WEBP":
        thousandths = islice(iter_frame_durations(fps, 1000), len(pictures))
        options = {"duration": list(thousandths), "quality": WEBP_QUALITY}
    if options:
        options |= {"save_all": True, "append_images": pictures[1:], "loop": 0}
    with atomic_path(path) as partial:
        pictures[0].save(partial, kind, **options)
