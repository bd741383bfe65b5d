"""From pictures of any scene behind a kaleidoscope to the homography of each view.

Patches about places of the centre view are looked for in every other view, from the grid's mirror
images on, in small pictures and then in full ones; a homography is fitted to what was found, and to
corner views the angle between their halves.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from src.recordings.calibration.activity_pictures import Pictures, keep_windows_with_motion
from src.recordings.calibration.boards import Points
from src.recordings.calibration.scene_matches import PatchMatcher, ViewMatches
from src.recordings.calibration.view_alignment import AlignedViews
from src.recordings.calibration.view_coverage import (
    describe_grid,
    leave_out_blocked_views,
    share_of_events_outside_views,
)
from src.recordings.calibration.view_field import Rectangle, cut_field, shrink_field
from src.recordings.calibration.view_fit import find_folds, fit_view
from src.recordings.calibration.view_grid import OTHER_GRIDS, ViewGrid, find_grid
from src.recordings.corner_fold import CornerFold
from src.recordings.views import HeightWidth, View, Views
from src.sim.optics import Position

FoundViews = Mapping[Position, View]
COARSE_PITCHES = (50, 100)  # px of a view in small pictures, which bear the first search
COARSE_PATCHES, FINE_PATCHES = 3, 4  # along the shorter side of a view
REACH_PX = 5  # of a search in full pictures


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
class SceneAlignment:
    """`aligned`: the views, and their points within SceneTarget's `error_px`.  `matched`: these
    points' share of the places with structure.  `held_out_px`: the median distance at places of
    every second window from a fit to the others; empty where one window alone shows motion.
    `grid`: rows and columns, and the share of the events in no view, for a person."""

    aligned: AlignedViews
    matched: Mapping[Position, float]
    held_out_px: Mapping[Position, float]
    grid: str

    def summary(self) -> dict[str, str]:
        """Return a line for the grid and one per view, for a person."""
        lines = {"grid": self.grid}
        for view in self.aligned.views.views:
            text = f"error {view.error_px:.2f} px, {self.matched[view.position]:.0%} matched"
            held_out = self.held_out_px.get(view.position)
            after = "" if held_out is None else f", {held_out:.2f} px in windows left out"
            apart = abs(math.degrees(view.fold.angle_rad)) if view.fold else 0
            halves = f", halves {apart:.1f} degrees apart" if apart else ""
            lines[f"view {view.position}"] = text + after + halves
        return lines


def align_views_by_scene(
    pictures: Pictures, scene: SceneTarget, model: HeightWidth
) -> SceneAlignment:
    """Find the views in pictures of a recording's windows and fit their homographies, and the
    halves of corner views.

    Raises ValueError where no views repeat, the centre one shows too little, or another has ON and
    OFF exchanged, does not match it or lies off it by more than `scene.error_px` in windows left
    out.
    """
    pictures = keep_windows_with_motion(pictures)
    grid = leave_out_blocked_views(find_grid(pictures), pictures)
    shown = describe_grid(grid, share_of_events_outside_views(grid, pictures))
    _check_polarity(pictures, grid)
    held_out = _hold_out(pictures, grid) if len(pictures) > 1 else {}
    fitted, fine = _find_views(pictures, grid)
    matches = _match_views(fine, fitted)
    good = {at: match.residual_px <= scene.error_px for at, match in matches.items()}
    matched = {at: float(each.mean()) for at, each in good.items()}
    _check_matched(matched, scene)
    _check_held_out(held_out, scene)
    points = {at: match.at[good[at]] for at, match in matches.items()}
    residuals = {at: match.offset[good[at]] for at, match in matches.items()}
    views = _build_views(fitted, residuals, grid.centre_view_edges, pictures.shape[2:], model)
    aligned = AlignedViews(views, points, residuals)
    return SceneAlignment(aligned, matched, _median_px(held_out), shown)


def _match_views(
    pictures: PatchMatcher, views: FoundViews, reach: int = REACH_PX
) -> dict[Position, ViewMatches]:
    return {at: pictures.match(view, reach) for at, view in views.items()}


def _fit_views(
    matches: Mapping[Position, ViewMatches], views: FoundViews, tile: Rectangle,
    folds: Mapping[Position, CornerFold] = MappingProxyType({}),
) -> dict[Position, View]:  # fmt: skip
    """Return the views fitted to their matches; the centre one keeps its own homography."""
    return {
        at: fit_view(at, matches[at], tile, folds.get(at)) if at != (0, 0) else view
        for at, view in views.items()
    }


def _find_views(pictures: Pictures, grid: ViewGrid) -> tuple[dict[Position, View], PatchMatcher]:
    """Return the views after rounds in small pictures and in full ones, the last two with halves of
    corner views; and the full ones."""
    views, tile = _place_views(grid), grid.centre_view_edges
    for pitch in COARSE_PITCHES:
        small = _shrink(pictures, grid, pitch)
        views = _fit_views(_match_views(small, views, small.half), views, tile)
    fine = PatchMatcher(pictures, tile, FINE_PATCHES, match_groups_apart=True)
    views = _fit_views(_match_views(fine, views), views, tile)
    matches = _match_views(fine, views)
    folds = find_folds(matches, tile, _between_seams(views, tile))
    views = _fit_views(matches, views, tile, folds)
    return _fit_views(_match_views(fine, views), views, tile, folds), fine


def _place_views(grid: ViewGrid) -> dict[Position, View]:
    return {at: View(at, grid.homography(at)) for at in grid.positions}


def _shrink(pictures: Pictures, grid: ViewGrid, pitch: int) -> PatchMatcher:
    scale = max(1, round(min(grid.x.pitch, grid.y.pitch) / pitch))
    return PatchMatcher(pictures, grid.centre_view_edges, COARSE_PATCHES, scale)


def _hold_out(pictures: Pictures, grid: ViewGrid) -> dict[Position, ViewMatches]:
    """Fit to every second window, and return what is found in the others."""
    fitted, _ = _find_views(pictures[::2], grid)
    others = PatchMatcher(
        pictures[1::2], grid.centre_view_edges, FINE_PATCHES, match_groups_apart=True
    )
    return _match_views(others, fitted)


def _median_px(matches: Mapping[Position, ViewMatches]) -> dict[Position, float]:
    return {at: float(np.median(m.residual_px[m.found])) for at, m in matches.items()}


def _check_polarity(pictures: Pictures, grid: ViewGrid) -> None:
    """Raise ValueError for views that match the centre one at few places, and at more than half of
    them with ON and OFF exchanged; where most views do, it is the centre one."""
    views, small = _place_views(grid), _shrink(pictures, grid, COARSE_PITCHES[0])
    few = {at: m.found.mean() for at, m in _match_views(small, views, small.half).items()}
    few = {at: share for at, share in few.items() if share < 0.5}
    exchanged = {at: small.match(views[at], small.half, swap_polarity=True) for at in few}
    found = [at for at, m in exchanged.items() if m.found.mean() > max(0.5, 2 * few[at])]
    if found:
        names = " and ".join(map(str, found if len(found) < len(views) / 2 else [(0, 0)]))
        raise ValueError(
            f"recording must have ON and OFF alike in all views: those of view {names} are"
            " exchanged; exchange them back in the recording"
        )


def _check_matched(matched: Mapping[Position, float], scene: SceneTarget) -> None:
    worst = min(matched, key=lambda at: matched[at])
    if matched[worst] < scene.min_matched:
        raise ValueError(
            f"recording must show the same in all views: view {worst} matches at"
            f" {matched[worst]:.0%} of the places, target.min_matched={scene.min_matched} is"
            f" needed; too few events, parallax of a scene too near, or {OTHER_GRIDS}"
        )


def _check_held_out(held_out: Mapping[Position, ViewMatches], scene: SceneTarget) -> None:
    """Raise ValueError for a view off the centre one; where windows left out show too little, at
    less than `scene.min_matched` of the places, they do not tell."""
    telling = {at: m for at, m in held_out.items() if m.found.mean() >= scene.min_matched}
    off = _median_px(telling)
    worst = max(off, key=lambda at: off[at], default=(0, 0))
    if off and off[worst] > scene.error_px:
        raise ValueError(
            f"recording must show the same in all views: view {worst} is {off[worst]:.2f} px"
            f" off in windows left out, target.error_px={scene.error_px} is allowed; parallax of a"
            f" scene too near, or {OTHER_GRIDS} (use a board, target=)"
        )


def _build_views(
    fitted: FoundViews, residuals: Mapping[Position, Points], tile: Rectangle, sensor: HeightWidth,
    model: HeightWidth,
) -> Views:  # fmt: skip
    views = []
    for at, view in fitted.items():
        error = float(np.sqrt((residuals[at] ** 2).sum(1).mean()))
        views.append(replace(view, error_px=error, points=len(residuals[at])))
    field = shrink_field(cut_field(_between_seams(fitted, tile), model), views, sensor)
    return Views(sensor, model, field, tuple(views))


def _between_seams(views: FoundViews, tile: Rectangle) -> Rectangle:
    """Return where the centre view begins and ends: a seam lies half way between a pixel and its
    mirror image; a side without a neighbour is as far from the other as in the grid."""
    whole, edges = np.array(tile), np.full(4, np.nan)
    for side, at in enumerate(((0, -1), (-1, 0), (0, 1), (1, 0))):
        if at in views:
            pixels = np.linspace(tile[:2], tile[2:], 9)
            pixels[:, side % 2] = tile[side]
            edges[side] = (pixels + views[at].to_sensor(pixels))[:, side % 2].mean() / 2
    from_opposite = np.roll(edges - whole, 2) + whole
    for other in (from_opposite, whole):
        edges = np.where(np.isnan(edges), other, edges)
    left, top, right, bottom = edges.tolist()
    return left, top, right, bottom
