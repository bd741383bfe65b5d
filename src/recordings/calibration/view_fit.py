"""The homography of a view and the halves of a corner view, from places matched with the centre."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import cv2
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from src.recordings.calibration.scene_matches import ViewMatches
from src.recordings.calibration.view_field import Rectangle
from src.recordings.calibration.view_grid import OTHER_GRIDS
from src.recordings.corner_fold import MAX_ANGLE_RAD, CornerFold
from src.recordings.views import View
from src.sim.optics import Position

MIN_FOUND = 6  # places in another view
ROBUST_PX = 0.5  # a residual counts by its square up to here, beyond by its length
LOOSE_PX = 30.0  # how far a corner may leave the affine map for ROBUST_PX less elsewhere
FOLD_GAIN = 0.125  # of the cost, by halves; where there are none they gain up to 0.1
CROSSING_STEPS = (0.12, 0.06, 0.03)  # of the centre view, from its middle to where lines cross


def fit_view(
    position: Position, match: ViewMatches, tile: Rectangle, fold: CornerFold | None = None
) -> View:
    """Fit the homography of a view to the places found, robustly.

    The angle of `fold` is fitted to patches that lie in one half, and left out where it lowers the
    cost by less than FOLD_GAIN or a half has fewer than MIN_FOUND.  Raises ValueError for fewer
    than MIN_FOUND places.
    """
    if fold:
        off = fold.signed_distance_px(match.places)
        halves = [match.found & (side * off > match.half_px) for side in (-1, 1)]
        if min(half.sum() for half in halves) >= MIN_FOUND:
            clear = match.keep(halves[0] | halves[1])
            view, cost = _fit(position, clear, tile, fold)
            if cost <= (1 - FOLD_GAIN) * _fit(position, clear, tile, None)[1]:
                return view
    return _fit(position, match, tile, None)[0]


def find_folds(
    matches: Mapping[Position, ViewMatches], tile: Rectangle, seams: Rectangle
) -> dict[Position, CornerFold]:
    """Return the lines at which the halves of the corner views meet, the angles not yet known.

    They begin at the corners of the centre view, `seams`, and cross at one point, where a mirror
    seen edge on would vanish: of places near the middle that which fits best.
    """
    left, top, right, bottom = seams
    corners = {
        (row, col): (right if col > 0 else left, bottom if row > 0 else top)
        for row, col in matches
        if abs(row) == abs(col) == 1
    }
    best: dict[Position, CornerFold] = {}
    least, middle = np.inf, np.array([left + right, top + bottom]) / 2
    for step in CROSSING_STEPS if corners else ():
        around = middle
        for shift in product((-step, 0, step), repeat=2):
            x, y = around + np.multiply(shift, (right - left, bottom - top))
            folds = {at: CornerFold(c, (float(x), float(y))) for at, c in corners.items()}
            cost = sum(_fit(at, matches[at], tile, fold)[1] for at, fold in folds.items())
            if cost < least:
                best, least, middle = folds, cost, np.array([x, y])
    return best


def _fit(
    position: Position, match: ViewMatches, tile: Rectangle, fold: CornerFold | None
) -> tuple[View, float]:
    """Return the fit and its cost: an affine map by RANSAC, then the four corners of `tile` and the
    angle by least squares."""
    at, places = match.at[match.found], match.places[match.found]
    enough = len(at) >= MIN_FOUND
    affine = cv2.estimateAffine2D(at, places, ransacReprojThreshold=6.0)[0] if enough else None
    if affine is None:
        got = f"view {position} shows {len(at)} of {len(match.places)} places of the centre view"
        raise ValueError(
            f"recording: {got}, {MIN_FOUND} are needed; record more motion, unless it is blocked or"
            f" in {OTHER_GRIDS}"
        )
    start, shape = np.vstack([affine, [0, 0, 1]]), _normalise(tile)
    back, shape_px = np.linalg.inv(shape), 1 / np.diag(shape)[:2].mean()

    def homography(change: np.ndarray) -> np.ndarray:
        moved = np.eye(3) + np.append(change[:8], 0).reshape(3, 3)
        matrix = back @ moved @ shape @ start
        return matrix / matrix[2, 2]

    def angle_rad(change: np.ndarray) -> float:
        return float(np.clip(change[8], -MAX_ANGLE_RAD, MAX_ANGLE_RAD))

    def view(change: np.ndarray) -> View:
        turned = replace(fold, angle_rad=angle_rad(change)) if fold else None
        return View(position, homography(change), fold=turned)

    def errors(change: np.ndarray) -> np.ndarray:
        placed = cv2.perspectiveTransform(at[None], homography(change))[0]
        placed = fold.turn(placed, angle_rad(change) / 2) if fold else placed
        off = placed - places
        return np.concatenate([off.ravel(), change * shape_px * ROBUST_PX / LOOSE_PX])

    zero = np.zeros(9 if fold else 8)
    found: OptimizeResult = least_squares(errors, zero, loss="soft_l1", f_scale=ROBUST_PX)
    return view(found.x), float(found.cost)


def _normalise(tile: Rectangle) -> np.ndarray:
    """Return the map of `tile` to -1..1."""
    left, top, right, bottom = tile
    a, b = 2 / (right - left), 2 / (bottom - top)
    return np.array([[a, 0, -1 - left * a], [0, b, -1 - top * b], [0, 0, 1.0]])
