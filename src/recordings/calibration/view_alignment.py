"""From a picture that shows one target in every view to the homography of each view.

The targets are found anywhere on the sensor, sorted into a grid, un-mirrored and matched to that of
the centre view.  Points are (x, y) in sensor pixels, float64.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float, UInt8

from src.recordings.calibration.board_order import order_points_as_in_centre_view, shows_half_turn
from src.recordings.calibration.boards import Points, Target, cluster_points
from src.recordings.calibration.view_field import Rectangle, cut_field, shrink_field
from src.recordings.calibration.view_numbering import assign_view_positions
from src.recordings.views import HeightWidth, View, Views
from src.records import safe_yaml
from src.sim.optics import Position

MIN_VIEWS = 4
MIN_SPAN = 0.75  # of the board's width and height in the centre view: less is warned of
MAX_ERROR_PX = 1.5  # a point further off is an outlier of the homography
FLIPS = ((False, False), (True, False), (False, True), (True, True))


def repair_picture(counts: Float[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """Return counts of events, or any picture, as uint8; a pixel that stands out of its neighbours
    by half the range gets their median (a median everywhere would move a target's corners).
    """
    counts = counts.astype(np.float32)
    median = cv2.medianBlur(counts, 3)
    low, high = np.percentile(median, [1, 99.5])
    repaired = np.where(np.abs(counts - median) > (high - low) / 2, median, counts)
    return np.clip((repaired - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)


def find_target_in_views(
    picture: UInt8[np.ndarray, "h w"], target: Target, are_mirrored: bool = True
) -> dict[Position, Points]:
    """Return the points of `target` in each view of a sensor picture in which it is found, row by
    row, NaN where one is not seen.  `are_mirrored`: the view at (row, col) is mirrored in x for odd
    col and in y for odd row; a target that knows its hand (ChArUco) decides itself.

    Raises ValueError where two targets have one position.
    """
    clusters = cluster_points(target.detect_candidate_points(picture), target.candidate_count)
    clusters = [cluster for cluster in clusters if _shows_target(picture, cluster, target)]
    points: dict[Position, Points] = {}
    mirrored: dict[Position, tuple[bool, bool]] = {}
    positions = assign_view_positions(clusters, picture.shape)
    for position, cluster in zip(positions, clusters, strict=True):
        row, col = position
        physical = (bool(are_mirrored and col % 2), bool(are_mirrored and row % 2))
        for flip in FLIPS if target.ordered else (physical,):
            seen = _find_flipped(picture, cluster, target, flip)
            if seen is not None:
                known = points.get(position)
                points[position] = seen if known is None else _choose_fuller(position, known, seen)
                mirrored[position] = flip
                break
    if (0, 0) in points and not target.ordered:
        points = {
            at: order_points_as_in_centre_view(points[0, 0], seen, target, mirrored[at], picture)
            for at, seen in points.items()
        }
    if not (are_mirrored or shows_half_turn(target)):
        line = (
            "views are taken as upright, one turned by 180 degrees would be wrong; target=charuco"
        )
        warnings.warn(f"{line} or a checkerboard of one odd and one even side tells", stacklevel=2)
    return points


def _shows_target(picture: np.ndarray, cluster: Points, target: Target) -> bool:
    """Return whether `target` is found around `cluster`, mirrored or not."""
    return any(_find_flipped(picture, cluster, target, flip) is not None for flip in FLIPS)


def _choose_fuller(position: Position, one: Points, other: Points) -> Points:
    """Return of one target found twice the points of which more are seen.

    Raises ValueError for two targets.
    """
    places = [np.nanmean(points, axis=0) for points in (one, other)]
    size = np.nanmax(one, axis=0) - np.nanmin(one, axis=0)
    if (np.abs(places[1] - places[0]) >= size).any():
        there = " and ".join(f"({x:.0f}, {y:.0f})" for x, y in places)
        raise ValueError(
            f"calibrate: view {position} must show one target, got two at pixels (x, y) {there};"
            " rows and columns of views must lie along those of the sensor"
        )
    return max(one, other, key=lambda points: np.isfinite(points).sum())


def _find_flipped(picture: np.ndarray, cluster: Points, target: Target, flip) -> Points | None:
    """Find the target around `cluster`, the picture mirrored by `flip`; return sensor pixels."""
    pitch = np.ptp(cluster, axis=0).max() / max(target.shape)
    height, width = picture.shape
    left, top = np.maximum(np.floor(cluster.min(0) - 1.7 * pitch), 0).astype(int)
    right, bottom = np.ceil(cluster.max(0) + 1.7 * pitch).astype(int) + 1
    crop = picture[top : min(bottom, height), left : min(right, width)]
    crop = crop[:: -1 if flip[1] else 1, :: -1 if flip[0] else 1]
    points = target.find_points(np.ascontiguousarray(crop))
    if points is None:
        return None
    last = np.array(crop.shape[::-1]) - 1
    return np.where(flip, last - points, points) + np.array([left, top])


@dataclass(frozen=True)
class AlignedViews:
    """`views`, and per position the points used and what is left of them in the centre view."""

    views: Views
    points: Mapping[Position, Points]
    residuals: Mapping[Position, Points]


def fit_homographies(
    found: Mapping[Position, Points], *, sensor: HeightWidth, model: HeightWidth
) -> AlignedViews:
    """Fit the homography of every view to the centre view, by RANSAC.

    The field is the centre view's tile, cut to the model's aspect and by MARGIN of its side.
    Raises ValueError for fewer than four views, or without the centre one.
    """
    if len(found) < MIN_VIEWS or (0, 0) not in found:
        seen = sorted(found)
        raise ValueError(
            f"calibrate: the target must be seen in {MIN_VIEWS} or more views and in the centre"
            f" one, got {len(seen)}: {seen}; give corners= by hand or another target="
        )
    centre = found[0, 0]
    board = np.ptp(centre[np.isfinite(centre).all(1)], axis=0)
    views, used, residuals, spans = [], {}, {}, {}
    for at in sorted(found):
        both = np.isfinite(found[at]).all(1) & np.isfinite(centre).all(1)
        points, onto = found[at][both], centre[both]
        if (shared := len(points)) < 6:
            needed = "6 or more points with the centre"
            raise ValueError(f"calibrate: view {at} must share {needed}, got {shared}")
        matrix, good = cv2.findHomography(points, onto, cv2.RANSAC, MAX_ERROR_PX, maxIters=5000)
        if matrix is None:
            raise ValueError(f"calibrate: no homography fits view {at} within {MAX_ERROR_PX} px")
        good = good.ravel().astype(bool)
        used[at] = points[good]
        residuals[at] = cv2.perspectiveTransform(points[None, good], matrix)[0] - onto[good]
        error = float(np.sqrt((residuals[at] ** 2).sum(1).mean()))
        views.append(View(at, matrix, error, len(used[at])))
        spans[at] = float((np.ptp(onto[good], axis=0) / board).min())
    _warn_of_small_spans(spans)
    field = shrink_field(cut_field(_between_boards(found), model), views, sensor)
    return AlignedViews(Views(sensor, model, field, tuple(views)), used, residuals)


def _warn_of_small_spans(spans: Mapping[Position, float]) -> None:
    """Warn of views whose points span little of the board's width or height in the centre view."""
    small = {at: span for at, span in spans.items() if span < MIN_SPAN}
    if small:
        listed = ", ".join(f"view {at} {span:.0%}" for at, span in small.items())
        warnings.warn(
            f"points span little of the board's width or height: {listed}; beyond them the"
            " homography is extrapolated, by a pixel or more",
            stacklevel=3,
        )


def _between_boards(found: Mapping[Position, Points]) -> Rectangle:
    """Return the centre tile: bounded half way between a point and its image in each neighbour."""
    centre = found[0, 0]
    middle = np.tile(np.nanmean(centre, axis=0), 2)
    edges = np.full(4, np.nan)
    for side, at in enumerate(((0, -1), (-1, 0), (0, 1), (1, 0))):
        if at in found:
            edges[side] = np.nanmean((centre + found[at]) / 2, axis=0)[side % 2]
    if np.isnan(edges).all():
        raise ValueError("calibrate: the target must be seen beside the centre view, got none")
    edges = np.where(np.isnan(edges), 2 * middle - np.roll(edges, 2), edges)
    reach = np.nanmedian(np.abs(edges - middle))  # where views have one row or column
    edges = np.where(np.isnan(edges), middle + reach * np.array([-1, -1, 1, 1]), edges)
    left, top, right, bottom = edges.tolist()
    return left, top, right, bottom


def views_from_corners(
    corners: Mapping[Position, Points], *, sensor: HeightWidth, model: HeightWidth
) -> Views:
    """Return the views whose four corners, those of one rectangle of the scene, are given.

    The field is the bounding rectangle of the centre view's, cut to the model's aspect.  Raises
    ValueError without the centre view, or for other than four finite corners.
    """
    for at, quad in corners.items():
        if np.shape(quad) != (4, 2) or not np.isfinite(quad).all():
            raise ValueError(f"calibrate.corners of view {at} must be four (x, y), got {quad}")
    if (0, 0) not in corners:
        got = sorted(corners)
        raise ValueError(f"calibrate.corners must have the centre view (0, 0), got {got}")
    centre = corners[0, 0].astype(np.float32)
    views = [
        View(at, cv2.getPerspectiveTransform(corners[at].astype(np.float32), centre), 0.0, 4)
        for at in sorted(corners)
    ]
    field = (*centre.min(0).tolist(), *centre.max(0).tolist())
    return Views(sensor, model, cut_field(field, model, margin=0.0), tuple(views))


def read_corners(path: Path | str, are_mirrored: bool = True) -> dict[Position, Points]:
    """Read corners given by hand: a YAML list of {position: [row, col], corners: four [x, y]}.

    Raises ValueError for anything else: a position that comes twice, corners that are not those of
    a convex quadrilateral one after the other, or, with `are_mirrored`, of the wrong hand.
    """
    try:
        entries = [
            (entry["position"], np.array([(float(x), float(y)) for x, y in entry["corners"]]))
            for entry in safe_yaml.read(path)
        ]
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, OverflowError) as error:
        fault = f"{type(error).__name__} {error}"
        got = f"{path}: {error.strerror if isinstance(error, OSError) else fault}"
        raise ValueError(f"corners must be a list of position and corners, got {got}") from None
    try:
        corners = _collect_corners(entries)
        if are_mirrored:
            _check_hands(corners)
    except ValueError as error:
        raise ValueError(f"corners={path}: {error}") from None
    return corners


def _collect_corners(entries: Sequence[tuple[Any, np.ndarray]]) -> dict[Position, Points]:
    found: dict[Position, Points] = {}
    for at, quad in entries:
        is_pair = isinstance(at, list) and len(at) == 2
        if not is_pair or any(type(number) is not int for number in at):
            raise ValueError(f"position must be two whole numbers, [row, col], got {at}")
        if (position := (at[0], at[1])) in found:
            raise ValueError(f"view {position} must be there once, got it twice")
        if _find_turn(quad) == 0:
            needed = "four corners of a convex quadrilateral, one after the other"
            raise ValueError(f"view {position} must have {needed}, got {quad.tolist()}")
        found[position] = quad
    return found


def _check_hands(corners: Mapping[Position, Points]) -> None:
    """Raise ValueError for a view that is not mirrored against the centre one as its position is:
    once for an odd sum of row and column."""
    for position, quad in corners.items():
        is_odd, centre = sum(position) % 2 == 1, corners.get((0, 0))
        if centre is not None and (_find_turn(quad) != _find_turn(centre)) != is_odd:
            needed = "mirrored in one axis" if is_odd else "mirrored in both axes or in none"
            got = f"corners that are {'not' if is_odd else 'mirrored in one'}, {quad.tolist()}"
            raise ValueError(f"view {position} must be {needed} with mirrors=true, got {got}")


def _find_turn(quad: Float[np.ndarray, "..."]) -> int:
    """Return 1 or -1, the way in which corners of a convex quadrilateral turn, or 0 for others."""
    if quad.shape != (4, 2) or not np.isfinite(quad).all():
        return 0
    edges = np.roll(quad, -1, axis=0) - quad
    following = np.roll(edges, -1, axis=0)
    turns = np.sign(edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0])
    return int(turns[0]) if (turns == turns[0]).all() else 0
