"""The sensor lookup: one pass over a stream splits it into registered views."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from src.recordings.corner_fold import Points
from src.recordings.engines.splat import (
    list_bilinear_contributions,
    list_nearest_contributions,
    splat_and_count_outside,
)
from src.recordings.files.event_arrays import contiguous_columns
from src.recordings.views import HeightWidth, View, Views

MIN_DENSITY = 0.1  # where fewer sensor pixels than this map to a model pixel, no scaling up


@dataclass(frozen=True)
class SensorLookup:
    """For each sensor pixel the index of its `view`, -1 for none, and its place `model_xy` in
    model pixels; `views`: how many there are, `model`: (height, width) of each."""

    view: Int[np.ndarray, "h w"]
    model_xy: Float[np.ndarray, "h w 2"]
    views: int
    model: HeightWidth

    def empty_grid(self, bins: int) -> Float[np.ndarray, "views bins h w"]:
        return np.zeros((self.views, bins, *self.model), np.float32)

    def add_to_grid(
        self, events: np.ndarray, grid: Float[np.ndarray, "views bins h w"], start_us: float,
        end_us: float, *, nearest: bool = False,
    ) -> int:  # fmt: skip
        """Add `events` (fields t x y p) to `grid` and return how many lie in no view.

        An event weighs by E2VID's hat in the time from `start_us` to `end_us`, and bilinearly or at
        the nearest pixel in space.  Raises ValueError for an event off the sensor.
        """
        self.check_on_sensor(events)
        t, x, y, p = contiguous_columns(events, "txyp")
        edges = float(start_us), float(end_us)
        return splat_and_count_outside(t, x, y, p, self.view, self.model_xy, grid, *edges, nearest)

    def list_contributions(
        self, events: np.ndarray, density: Float[np.ndarray, "views 1 h w"], *, nearest: bool
    ) -> tuple[tuple[np.ndarray, ...], int]:
        """Return what `add_to_grid` would add over `density`, one entry for every pixel that an
        event contributes to: (index of the event, x, y, weight, view), and how many events lie in
        no view.
        """
        self.check_on_sensor(events)
        count = (1 if nearest else 4) * len(events)
        dtypes = (np.int64, np.int64, np.int64, np.int64, np.float32)
        index, u, v, which, weight = made = [np.empty(count, dtype) for dtype in dtypes]
        x, y, p = contiguous_columns(events, "xyp")
        if nearest:
            geometry = self.nearest_model_pixel, density[:, 0]
            entries, outside = list_nearest_contributions(x, y, p, *geometry, *made)
        else:
            parts = self.view, self.model_xy, density[:, 0]
            entries, outside = list_bilinear_contributions(x, y, p, *parts, *made)
        return tuple(part[:entries] for part in (index, u, v, weight, which)), outside

    @cached_property
    def nearest_model_pixel(self) -> Int[np.ndarray, "h w"]:
        """For each sensor pixel its nearest model pixel, counted through all views; -1: none."""
        limit = np.array(self.model[::-1]) - 1
        column, row = np.clip((self.model_xy + 0.5).astype(np.int32), 0, limit).transpose(2, 0, 1)
        pixel = (self.view.astype(np.int32) * self.model[0] + row) * self.model[1] + column
        return np.where(self.view >= 0, pixel, -1).astype(np.int32)

    @cached_property
    def density(self) -> dict[str, Float[np.ndarray, "views 1 h w"]]:
        """Sensor pixels per model pixel, as events are laid, `bilinear` and `nearest`; a grid over
        it is in events per sensor pixel."""
        y, x = np.nonzero(self.view >= 0)
        time, one = np.zeros(len(x), np.int64), np.ones(len(x), np.int8)
        grids = {"bilinear": self.empty_grid(1), "nearest": self.empty_grid(1)}
        for kind, grid in grids.items():
            geometry = self.view, self.model_xy, grid
            splat_and_count_outside(time, x, y, one, *geometry, 0.0, 1.0, kind == "nearest")
        return {kind: np.maximum(grid, MIN_DENSITY) for kind, grid in grids.items()}

    def check_on_sensor(self, events: np.ndarray) -> None:
        """Raise ValueError where an event lies off the sensor."""
        height, width = self.view.shape
        if events.size and (events["x"].max() >= width or events["y"].max() >= height):
            got = f"(x, y) up to {int(events['x'].max()), int(events['y'].max())}"
            raise ValueError(f"events must lie on the {width}x{height} sensor of views, got {got}")


def build_lookup(views: Views) -> SensorLookup:
    """Return the lookup of `views`; where two overlap, the one whose centre is nearer wins."""
    height, width = views.sensor
    y, x = np.mgrid[:height, :width].astype(np.float64)
    best = np.full((height, width), np.inf)
    owner = np.full((height, width), -1, np.int16)
    model_xy = np.zeros((height, width, 2), np.float32)
    middle = (np.array(views.model[::-1]) - 1) / 2
    half = np.array(views.model[::-1]) / 2
    for index, view in enumerate(views.views):
        outline, (a, b, c) = views.outline(view), view.homography[2]
        near = _surround(view, outline, views.sensor)
        sensor = np.stack([x[near].ravel(), y[near].ravel()], axis=1)
        uv = views.to_model(view, sensor).reshape(*x[near].shape, 2)
        # Beyond the homography's horizon the plane comes again.
        depth = a * x[near] + b * y[near] + c
        front = depth * (outline.mean(0) @ (a, b) + c) > 0
        distance = np.abs((uv - middle) / half).max(-1)
        mine = front & (distance <= 1) & (distance < best[near])
        best[near][mine], owner[near][mine] = distance[mine], index
        model_xy[near][mine] = uv[mine]
    return SensorLookup(owner, model_xy, len(views.views), views.model)


def _surround(view: View, outline: Points, sensor: HeightWidth) -> tuple[slice, slice]:
    """Return rows and columns that hold all of a view; of halves, or one that reaches its horizon,
    those of the sensor."""
    depth = np.append(outline, np.ones((4, 1)), axis=1) @ view.homography[2]
    if view.fold or abs(np.sign(depth).sum()) < 4:
        return slice(0, sensor[0]), slice(0, sensor[1])
    (left, top), (right, bottom) = outline.min(0), outline.max(0)
    first = np.clip(np.floor([top, left]) - 1, 0, sensor).astype(int)
    last = np.clip(np.ceil([bottom, right]) + 2, 0, sensor).astype(int)
    rows, columns = (slice(*ends) for ends in zip(first.tolist(), last.tolist(), strict=True))
    return rows, columns
