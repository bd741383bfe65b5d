"""From pictures of any scene behind a kaleidoscope to the homography of each view.

Patches about places of the centre view are looked for in every other view, from the grid's mirror
images on, in small pictures and then in full ones; a homography is fitted to what was found.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from src.recordings.calibration.activity_pictures import (
    Pictures,
    describe_structure,
    shrink_pictures,
)
from src.recordings.calibration.boards import Points
from src.recordings.calibration.patch_matching import choose_places, find_patches
from src.recordings.calibration.view_alignment import AlignedViews, Rectangle, cut_field
from src.recordings.calibration.view_grid import find_grid
from src.recordings.views import Size, View, Views
from src.sim.optics import Position

MIN_PLACES = 12  # with structure, in the centre view
MIN_FOUND = 6  # of them in another view
SMALL_PITCHES = (50, 100)  # px of a view in small pictures, which bear the first search
REACH_PX = 5  # of a search in full pictures
GROUPS = 4  # of windows, each one picture a kind
ROBUST_PX = 0.5  # a residual counts by its square up to here, beyond by its length
LOOSE_PX = 30.0  # how far a corner may leave the affine map for ROBUST_PX less elsewhere
Matrix = Float[np.ndarray, "3 3"]
Homographies = Mapping[Position, Matrix]


@dataclass(frozen=True)
class SceneTarget:
    """Any scene that all views show, instead of a board.

    A place counts as matched where it is found within `error_px` of where the homography puts it;
    parallax moves it away.  Every view must match at `min_matched` of the places.
    """

    error_px: float = 1.5
    min_matched: float = 0.4

    def __post_init__(self):
        if not 0 < self.error_px <= 10:
            raise ValueError(f"target.error_px must be in (0, 10], got {self.error_px}")
        if not 0 < self.min_matched <= 1:
            raise ValueError(f"target.min_matched must be in (0, 1], got {self.min_matched}")


@dataclass(frozen=True)
class ViewMatches:
    """Places of the centre view `at` which another view shows them, in its own pixels, and the
    `offset` from where its homography says, in pixels of the centre view; NaN where not found."""

    places: Points
    at: Points
    offset: Points

    @property
    def found(self) -> Bool[np.ndarray, " places"]:
        return np.isfinite(self.offset[:, 0])

    @property
    def distance_px(self) -> Float[np.ndarray, " places"]:
        return np.where(self.found, np.linalg.norm(self.offset, axis=1), np.inf)


@dataclass(frozen=True)
class SceneAlignment:
    """`aligned`: the views, and their points within SceneTarget's `error_px`.  `matched`: these
    points' share of the places with structure.  `held_out_px`: the median distance at places of
    every second window from a fit to the others; empty for a recording of one window."""

    aligned: AlignedViews
    matched: Mapping[Position, float]
    held_out_px: Mapping[Position, float]

    def summary(self) -> dict[str, str]:
        """Return a line per view, for a person."""
        lines = {}
        for view in self.aligned.views.views:
            text = f"error {view.error_px:.2f} px, {self.matched[view.position]:.0%} matched"
            held_out = self.held_out_px.get(view.position)
            after = "" if held_out is None else f", {held_out:.2f} px in windows left out"
            lines[f"view {view.position}"] = text + after
        return lines


class ScaledPictures:
    """Pictures of windows, joined and shrunk by a whole factor, and the places with structure in
    the centre view's `tile`.  Raises ValueError for fewer than MIN_PLACES.
    """

    def __init__(self, pictures: Pictures, tile: Rectangle, scale: int = 1):
        groups = np.array_split(pictures, min(GROUPS, len(pictures)))
        joined = np.stack([group.sum(0) for group in groups])
        self.structure = describe_structure(shrink_pictures(joined, scale), 1.2, 8.0)
        left, top, right, bottom = (edge / scale for edge in tile)
        self.half = int(np.clip(min(right - left, bottom - top) / 6, 8, 40))
        self.places = choose_places(self.structure, (left, top, right, bottom), self.half)
        if len(self.places) < MIN_PLACES:
            needed = f"structure at {MIN_PLACES} or more places of the centre view"
            raise ValueError(f"recording must show {needed}, got {len(self.places)}")
        middle = (scale - 1) / 2
        self.to_full = np.array([[scale, 0, middle], [0, scale, middle], [0, 0, 1.0]])

    def match(self, matrix: Matrix, reach: int) -> ViewMatches:
        """Look for the places in the view that `matrix` maps to the centre one, up to `reach` off
        along x and y, in pixels of these pictures."""
        small = np.linalg.inv(self.to_full) @ matrix @ self.to_full
        size = self.structure.shape[:0:-1]
        view = np.stack([cv2.warpPerspective(p, small, size) for p in self.structure])
        offset = find_patches(self.structure, view, self.places, self.half, reach)
        placed = self.places.astype(np.float64)
        places, moved = (_apply(self.to_full, each) for each in (placed, placed + offset))
        return ViewMatches(places, _apply(np.linalg.inv(matrix), moved), moved - places)


def align_scene(pictures: Pictures, scene: SceneTarget, model: Size) -> SceneAlignment:
    """Find the views in pictures of a recording's windows and fit their homographies.

    Raises ValueError where no views repeat, the centre one shows too little or another does not
    match it.
    """
    grid = find_grid(pictures)
    start = {at: grid.homography(at) for at in grid.positions}
    for pitch in SMALL_PITCHES:
        scale = max(1, round(min(grid.x.pitch, grid.y.pitch) / pitch))
        small = ScaledPictures(pictures, grid.tile, scale)
        start = _fit_views(small, start, grid.tile, small.half)
    held_out = _hold_out(pictures, start, grid.tile) if len(pictures) > 1 else {}
    matrices, matches = _refine(ScaledPictures(pictures, grid.tile), start, grid.tile)
    good = {at: match.distance_px <= scene.error_px for at, match in matches.items()}
    matched = {at: float(each.mean()) for at, each in good.items()}
    _check_matched(matched, scene)
    points = {at: match.at[good[at]] for at, match in matches.items()}
    residuals = {at: match.offset[good[at]] for at, match in matches.items()}
    views = _build_views(matrices, residuals, grid.tile, pictures.shape[2:], model)
    return SceneAlignment(AlignedViews(views, points, residuals), matched, held_out)


def fit_homography(position: Position, match: ViewMatches, tile: Rectangle) -> Matrix:
    """Fit the homography of a view to the places found, robustly: an affine map by RANSAC, then the
    four corners of `tile` by least squares.  Raises ValueError for fewer than MIN_FOUND places."""
    at, places = match.at[match.found], match.places[match.found]
    enough = len(at) >= MIN_FOUND
    affine = cv2.estimateAffine2D(at, places, ransacReprojThreshold=6.0)[0] if enough else None
    if affine is None:
        got = f"view {position} shows {len(at)} of {len(match.places)} places of the centre view"
        raise ValueError(f"recording: {got}, {MIN_FOUND} are needed; record more motion")
    start, shape = np.vstack([affine, [0, 0, 1]]), _normalise(tile)
    shape_px = 1 / np.diag(shape)[:2].mean()

    def matrix(change: np.ndarray) -> Matrix:
        change = np.eye(3) + np.append(change, 0).reshape(3, 3)
        return np.linalg.inv(shape) @ change @ shape @ start

    def errors(change: np.ndarray) -> np.ndarray:
        off = _apply(matrix(change), at) - places
        return np.concatenate([off.ravel(), change * shape_px * ROBUST_PX / LOOSE_PX])

    found = least_squares(errors, np.zeros(8), loss="soft_l1", f_scale=ROBUST_PX)
    return matrix(found.x)


def _fit_views(
    pictures: ScaledPictures, start: Homographies, tile: Rectangle, reach: int
) -> dict[Position, Matrix]:
    """Return the homographies of one round of search; the centre view keeps its own."""
    return {
        at: fit_homography(at, pictures.match(matrix, reach), tile) if at != (0, 0) else matrix
        for at, matrix in start.items()
    }


def _refine(
    pictures: ScaledPictures, start: Homographies, tile: Rectangle
) -> tuple[dict[Position, Matrix], dict[Position, ViewMatches]]:
    """Return the homographies after two more rounds, and what the places say of them."""
    once = _fit_views(pictures, start, tile, REACH_PX)
    matrices = _fit_views(pictures, once, tile, REACH_PX)
    return matrices, _match_views(pictures, matrices)


def _match_views(pictures: ScaledPictures, matrices: Homographies) -> dict[Position, ViewMatches]:
    return {at: pictures.match(matrix, REACH_PX) for at, matrix in matrices.items()}


def _hold_out(pictures: Pictures, start: Homographies, tile: Rectangle) -> dict[Position, float]:
    """Fit to every second window, and return the median distance found in the others."""
    matrices, _ = _refine(ScaledPictures(pictures[::2], tile), start, tile)
    matches = _match_views(ScaledPictures(pictures[1::2], tile), matrices)
    return {at: float(np.median(m.distance_px[m.found])) for at, m in matches.items()}


def _check_matched(matched: Mapping[Position, float], scene: SceneTarget) -> None:
    worst = min(matched, key=lambda at: matched[at])
    if matched[worst] < scene.min_matched:
        raise ValueError(
            f"recording must show the same in all views: view {worst} matches at"
            f" {matched[worst]:.0%} of the places, target.min_matched={scene.min_matched} is"
            " needed; too few events, or parallax of a scene too near"
        )


def _build_views(
    matrices: Homographies, residuals: Mapping[Position, Points], tile: Rectangle, sensor: Size,
    model: Size,
) -> Views:  # fmt: skip
    views = []
    for at, matrix in matrices.items():
        error = float(np.sqrt((residuals[at] ** 2).sum(1).mean()))
        views.append(View(at, matrix / matrix[2, 2], error, len(residuals[at])))
    return Views(sensor, model, cut_field(_between_seams(matrices, tile), model), tuple(views))


def _between_seams(matrices: Homographies, tile: Rectangle) -> Rectangle:
    """Return where the centre view begins and ends: a seam lies half way between a pixel and its
    mirror image; a side without a neighbour is as far from the other as in the grid."""
    edges, known = list(tile), []
    for side, at in enumerate(((0, -1), (-1, 0), (0, 1), (1, 0))):
        if at in matrices:
            pixels = np.linspace(tile[:2], tile[2:], 9)
            pixels[:, side % 2] = tile[side]
            between = (pixels + _apply(np.linalg.inv(matrices[at]), pixels)) / 2
            edges[side] = float(between[:, side % 2].mean())
            known.append(side)
    for side in known:
        opposite = (side + 2) % 4
        if opposite not in known:
            edges[opposite] = edges[side] + tile[opposite] - tile[side]
    left, top, right, bottom = edges
    return left, top, right, bottom


def _normalise(tile: Rectangle) -> Matrix:
    """Return the map of `tile` to -1..1."""
    left, top, right, bottom = tile
    a, b = 2 / (right - left), 2 / (bottom - top)
    return np.array([[a, 0, -1 - left * a], [0, b, -1 - top * b], [0, 0, 1.0]])


def _apply(matrix: Matrix, points: Points) -> Points:
    """Return the points mapped, NaN for NaN."""
    x, y, scale = matrix[:, :2] @ points.T + matrix[:, 2:]
    return np.stack([x / scale, y / scale], axis=1)
