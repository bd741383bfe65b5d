"""Slices of a video in time: what stands still draws a straight line, what wobbles a wavy one.

A slice is the video sampled, between pixels by bilinear interpolation, at the same places of every
frame: time down, place across (the paper's x-t, y-t, r-t and theta-t plots, figures 6 to 10).
Coordinates are (x, y) in pixels, the centre of the first pixel is (0, 0), y points down.
"""

import math
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "places 2"]
KINDS = ("line", "circle", "spin", "still")


def cut(
    video: Float[np.ndarray, "frames h w"],
    *,
    fps: float,
    line: Sequence | None = None,
    circle: Sequence | None = None,
    spin: Sequence | None = None,
    still: int | None = None,
) -> tuple[Float[np.ndarray, "frames places"], Points]:
    """Return one slice and its points in the first frame: `line` [[x, y], [x, y]], `circle` [x, y,
    radius] or `spin` [x, y, radius, turns a second, degrees at the first frame]; of a `still` scene
    the middle row.
    """
    if spin:
        x, y, radius, turns, degrees = spin
        angles = math.radians(degrees) + 2 * math.pi * turns * np.arange(len(video)) / fps
        end = (x + radius * math.cos(angles[0]), y + radius * math.sin(angles[0]))
        return along(video, (x, y), angles, np.arange(0, radius + 1e-9)), straight((x, y), end)
    middle = video.shape[1] // 2
    ends = line or ((0, middle), (video.shape[2] - 1, middle))
    points = around(tuple(circle[:2]), circle[2]) if circle else straight(*map(tuple, ends))
    return sample(video, points), points


def sample(
    video: Float[np.ndarray, "frames h w"], points: Points
) -> Float[np.ndarray, "frames places"]:
    """Return the video at `points`, (frames, places) float32; outside the nearest pixel counts.

    Raises ValueError for a point further than a pixel outside the frame.
    """
    height, width = video.shape[1:]
    outside = (points < -1).any(1) | (points[:, 0] > width) | (points[:, 1] > height)
    if outside.any():
        x, y = points[outside][0]
        raise ValueError(f"a slice must stay in {width}x{height} px, got ({x:.1f}, {y:.1f})")
    x, y = points.T.astype(np.float32)[:, None]
    rows = [
        cv2.remap(frame.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for frame in video
    ]
    return np.concatenate(rows)


def straight(start: Sequence[float], end: Sequence[float], places: int | None = None) -> Points:
    """Return points from `start` to `end`, both kept, by default at most a pixel apart.

    A row gives x-t, a column y-t, a line from the centre of a rotation r-t.
    """
    places = places or math.ceil(math.dist(start, end)) + 1
    return np.linspace(start, end, places)


def around(centre: tuple[float, float], radius: float, places: int | None = None) -> Points:
    """Return points once around `centre`, by default at most a pixel apart, for theta-t.

    The angle grows from +x towards +y, clockwise as seen; point k stands at 2 pi k / places.
    """
    places = places or math.ceil(2 * math.pi * radius)
    angle = 2 * math.pi * np.arange(places) / places
    return np.array(centre) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def along(
    video: Float[np.ndarray, "frames h w"],
    centre: tuple[float, float],
    angles: Float[np.ndarray, " frames"],
    radii: Float[np.ndarray, " places"],
) -> Float[np.ndarray, "frames places"]:
    """Return the r-t slice whose ray turns: frame k is sampled at `radii` pixels from `centre`
    towards `angles[k]` (radians, as in `around`).

    A dot that circles with these angles draws a straight line at its radius.
    """
    rays = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    points = np.array(centre) + radii[None, :, None] * rays[:, None]
    rows = [sample(video[k : k + 1], points[k]) for k in range(len(video))]
    return np.concatenate(rows)


def shrunk(videos: Sequence[Float[np.ndarray, "_frames _h _w"]]) -> list[np.ndarray]:
    """Return the videos shrunk to the size of the smallest, areas averaged."""
    height, width = min(video.shape[1:] for video in videos)
    return [
        np.stack([cv2.resize(f, (width, height), interpolation=cv2.INTER_AREA) for f in video])
        for video in videos
    ]
