"""Space-time slices of a video: what stands still draws a straight line, what jitters a wavy one.

A slice is the video sampled, between pixels by bilinear interpolation, at the same places of every
frame: time down, place across (the paper's x-t, y-t, r-t and theta-t plots, figures 6, 9 and 11).
Coordinates are (x, y) in pixels, the centre of the first pixel is (0, 0), y points down.
"""

import math
from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from jaxtyping import Float

from src.metrics.slice_motion import SLICES
from src.recordings.output import resize_picture

Points = Float[np.ndarray, "places 2"]
Slice = Float[np.ndarray, "frames places"]
BORDER = cv2.BORDER_REPLICATE
KINDS = (*SLICES, "still")


def cut_slice(
    video: Float[np.ndarray, "frames h w"], *, fps: float, line: Sequence | None = None,
    circle: Sequence | None = None, spin: Sequence | None = None, still: int | None = None,
) -> tuple[Slice, Points]:  # fmt: skip
    """Return one slice and its points in the first frame: `line` [[x, y], [x, y]], `circle` [x, y,
    radius] or `spin` [x, y, radius, turns a second, degrees at the first frame]; of a `still` scene
    the middle row.  Raises ValueError, with the name of the slice, where it leaves the frame.
    """
    key = "spin" if spin else "circle" if circle else "line"
    if spin:
        x, y, radius, turns, degrees = spin
        angles_rad = math.radians(degrees) + 2 * math.pi * turns * np.arange(len(video)) / fps
        points = rotating_ray_xy((x, y), angles_rad, np.arange(0, radius + 1e-9))
    elif circle:
        points = circle_points(circle[:2], circle[2])
    else:
        middle = video.shape[1] // 2
        points = line_points(*(line or ((0, middle), (video.shape[2] - 1, middle))))
    return sample_points(video, points, key), points.reshape(-1, *points.shape[-2:])[0]


def name_axis(kind: str, points: Points) -> str:
    """Return the coordinate along a slice of `kind` through `points`: x of a row, y of a column, r
    along another line or a ray that turns, theta on a circle."""
    if kind in ("circle", "spin"):
        return {"circle": "theta", "spin": "r"}[kind]
    spread_x, spread_y = np.ptp(points, axis=0)
    return "x" if spread_y == 0 else "y" if spread_x == 0 else "r"


def sample_points(
    video: Float[np.ndarray, "frames h w"],
    points: Points | Float[np.ndarray, "frames places 2"],
    key: str = "a slice",
) -> Slice:
    """Return the video at `points`, of every frame or of each, float32; outside the nearest pixel
    counts.  Raises ValueError, with `key`, for a point further than a pixel outside the frame.
    """
    height, width = video.shape[1:]
    outside = (points < -1).any(-1) | (points[..., 0] > width) | (points[..., 1] > height)
    if outside.any():
        x, y = points[outside][0]
        raise ValueError(f"{key} must stay in {width}x{height} px, got ({x:.1f}, {y:.1f})")
    places = np.broadcast_to(points, (len(video), *points.shape[-2:])).astype(np.float32)
    rows = [
        cv2.remap(frame.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=BORDER)
        for frame, (x, y) in zip(video, places.transpose(0, 2, 1)[:, :, None], strict=True)
    ]
    return np.concatenate(rows)


def line_points(start: Sequence[float], end: Sequence[float]) -> Points:
    """Return points from `start` to `end`, both kept, at most a pixel apart.

    A row gives x-t, a column y-t, a line from the centre of a rotation r-t.
    """
    return np.linspace(start, end, math.ceil(math.dist(start, end)) + 1)


def circle_points(centre: Sequence[float], radius: float, places: int | None = None) -> Points:
    """Return points once around `centre`, by default at most a pixel apart, for theta-t.

    The angle grows from +x towards +y, clockwise as seen; point k stands at 2 pi k / places.
    """
    places = places or math.ceil(2 * math.pi * radius)
    angles_rad = 2 * math.pi * np.arange(places) / places
    return rotating_ray_xy(centre, angles_rad, np.array([float(radius)]))[:, 0]


def rotating_ray_xy(
    centre: Sequence[float], angles_rad: Float[np.ndarray, " frames"],
    radii: Float[np.ndarray, " places"],
) -> Float[np.ndarray, "frames places 2"]:  # fmt: skip
    """Return points `radii` pixels from `centre` towards `angles_rad[k]` (radians, as in
    `circle_points`): of a dot that circles with these angles the r-t slice is a straight line.
    """
    rays = np.stack([np.cos(angles_rad), np.sin(angles_rad)], axis=1)
    return np.array(centre) + radii[None, :, None] * rays[:, None]


def shrink_to_smallest(
    videos: Mapping[str, Float[np.ndarray, "_frames _h _w"]],
) -> dict[str, np.ndarray]:
    """Return the videos, by name, shrunk to the size of the smallest, areas averaged.

    Raises ValueError for one of another aspect ratio: shrunk it would miss that size by more than
    a pixel.
    """
    sizes = {name: video.shape[1:] for name, video in videos.items()}
    smallest = min(sizes, key=lambda name: math.prod(sizes[name]))
    height, width = sizes[smallest]
    for name, (own_height, own_width) in sizes.items():
        if abs(own_width * height - own_height * width) > max(own_height, own_width):
            got = f"{name} {own_height}x{own_width} and {smallest} {height}x{width} (h x w)"
            raise ValueError(f"videos must be of one aspect ratio, got {got}")
    return {
        name: np.stack([resize_picture(frame, (height, width)) for frame in video])
        for name, video in videos.items()
    }
