"""Places with structure in the centre view, looked for in another view."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from src.recordings.calibration.activity_pictures import (
    Pictures,
    band_pass_log,
    shrink_pictures,
)
from src.recordings.calibration.boards import Points
from src.recordings.calibration.patch_matching import Stack, choose_places, measure_patch_offsets
from src.recordings.calibration.view_field import Rectangle
from src.recordings.views import View, list_grid_points, sample_bilinear

MIN_PLACES = 12  # with structure, in the centre view
GROUPS = 4  # of windows, each one picture a kind


@dataclass(frozen=True)
class ViewMatches:
    """Places of the centre view `at` which another view shows them, in its own pixels, and the
    `offset` from where it should, in pixels of the centre view; NaN where not found.  A patch
    reaches `half_px` from its place."""

    places: Points
    at: Points
    offset: Points
    half_px: float

    @property
    def found(self) -> Bool[np.ndarray, " places"]:
        return np.isfinite(self.offset[:, 0])

    @property
    def residual_px(self) -> Float[np.ndarray, " places"]:
        return np.where(self.found, np.linalg.norm(self.offset, axis=1), np.inf)

    def keep(self, kept: Bool[np.ndarray, " places"]) -> "ViewMatches":
        return ViewMatches(self.places[kept], self.at[kept], self.offset[kept], self.half_px)


class PatchMatcher:
    """Pictures of windows in groups, shrunk by a whole factor `scale`, and the places with
    structure in the centre view's `tile`.

    `patches_per_side`: how many fit along its shorter side.  `match_groups_apart`: a place is
    looked for in each group by itself, as what moves may be nearer than what rests; else in all at
    once.  Raises ValueError for fewer than MIN_PLACES.
    """

    def __init__(
        self, pictures: Pictures, tile: Rectangle, patches_per_side: int, scale: int = 1, *,
        match_groups_apart: bool = False,
    ):  # fmt: skip
        self._kinds = pictures.shape[1]
        groups = np.array_split(pictures, min(GROUPS, len(pictures)))
        joined = [shrink_pictures(group.sum(0), scale) for group in groups]
        structure = [band_pass_log(each, 8.0) for each in joined]
        self._stacks = structure if match_groups_apart else [np.concatenate(structure)]
        self._scale, self._middle = scale, (scale - 1) / 2
        edges = np.array(tile) / scale
        self.half = int(np.clip(min(edges[2:] - edges[:2]) / 2 / patches_per_side, 8, 40))
        self._origin = np.maximum(np.floor(edges[:2]) - self.half, 0).astype(int)
        x, y = self._origin
        right, bottom = np.ceil(edges[2:]).astype(int) + self.half
        self._centre = [stack[:, y:bottom, x:right] for stack in self._stacks]
        inside = tuple(edges - np.tile(self._origin, 2))
        self._places = [choose_places(stack, inside, self.half) for stack in self._centre]
        if sum(map(len, self._places)) < MIN_PLACES:
            needed = f"structure at {MIN_PLACES} or more places of the centre view"
            got = sum(map(len, self._places))
            raise ValueError(f"recording must show {needed}, got {got}")

    def match(self, view: View, reach: int, swap_polarity: bool = False) -> ViewMatches:
        """Look for the places in `view`, up to `reach` off along x and y, in pixels of these
        pictures; with `swap_polarity` for ON where the centre view shows OFF."""
        size = self._centre[0].shape[1:]
        there = view.to_sensor(self._to_full(list_grid_points(*map(np.arange, size[::-1]))))
        there = (there - self._middle) / self._scale
        offsets = []
        for centre, stack, places in zip(self._centre, self._stacks, self._places, strict=True):
            if len(places):
                seen = np.stack([sample_bilinear(picture, there, size) for picture in stack])
                seen = self._swap_kinds(seen) if swap_polarity else seen
                offsets.append(measure_patch_offsets(centre, seen, places, self.half, reach))
        placed = self._to_full(np.concatenate(self._places))
        offset = self._scale * np.concatenate(offsets)
        at = view.to_sensor(placed + offset)
        return ViewMatches(placed, at, offset, float(self.half * self._scale))

    def _swap_kinds(self, stack: Stack) -> Stack:
        groups = stack.reshape(-1, self._kinds, *stack.shape[1:])
        return groups[:, ::-1].reshape(stack.shape)

    def _to_full(self, points: np.ndarray) -> Points:
        """Return where pixels of the cut, shrunk centre view lie on the sensor."""
        return (points + self._origin) * float(self._scale) + self._middle
