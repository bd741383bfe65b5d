"""The sensor lookup: one pass over a stream splits it into registered views."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, Int

from src.recordings.engines.splat import lay, lay_nearest, splat
from src.recordings.views import Size, Views

THINNEST = 0.1  # of `density`: where fewer sensor pixels than this look, events are not scaled up


@dataclass(frozen=True)
class Lookup:
    """For each sensor pixel the index of its view, -1 for none, and its (u, v) in model pixels."""

    view: Int[np.ndarray, "h w"]
    place: Float[np.ndarray, "h w 2"]
    views: int
    model: Size

    @property
    def pixels(self) -> Int[np.ndarray, " views"]:
        """Sensor pixels of each view: what event rates are divided by."""
        return np.bincount(self.view[self.view >= 0], minlength=self.views)

    def empty(self, bins: int) -> Float[np.ndarray, "views bins h w"]:
        """Return a voxel grid of zeros, float32."""
        return np.zeros((self.views, bins, *self.model), np.float32)

    def add(
        self,
        events: np.ndarray,
        grid: Float[np.ndarray, "views bins h w"],
        t0: float,
        t1: float,
        *,
        nearest: bool = False,
    ) -> int:
        """Add `events` (fields t x y p) to `grid` and return how many lie in no view.

        `t0 < t1` are the edges of the grid's window in microseconds; an event weighs by the hat of
        E2VID in time, and bilinearly (its polarity is kept in the sum) or at the nearest pixel in
        space.  Raises ValueError for an event off the sensor.
        """
        self.check(events)
        fields = (events[name] for name in "txyp")
        return splat(*fields, self.view, self.place, grid, float(t0), float(t1), nearest)

    def parts(
        self, events: np.ndarray, density: Float[np.ndarray, "views 1 h w"], *, nearest: bool
    ) -> tuple[tuple[np.ndarray, ...], int]:
        """Return what `add` would add over `density`, one entry for every pixel that an event is
        laid into: (index of the event, x, y, weight, view), and how many events lie in no view.
        """
        self.check(events)
        count = (1 if nearest else 4) * len(events)
        kinds = (np.int64, np.int64, np.int64, np.int64, np.float32)
        index, u, v, which, weight = made = [np.empty(count, kind) for kind in kinds]
        fields = [events[name] for name in "xyp"]
        if nearest:
            entries, outside = lay_nearest(*fields, self.nearest, density[:, 0], *made)
        else:
            entries, outside = lay(*fields, self.view, self.place, density[:, 0], *made)
        return tuple(part[:entries] for part in (index, u, v, weight, which)), outside

    @cached_property
    def nearest(self) -> Int[np.ndarray, "h w"]:
        """For each sensor pixel its nearest model pixel, counted through all views; -1: none."""
        limit = np.array(self.model[::-1]) - 1
        column, row = np.clip((self.place + 0.5).astype(np.int32), 0, limit).transpose(2, 0, 1)
        pixel = (self.view.astype(np.int32) * self.model[0] + row) * self.model[1] + column
        return np.where(self.view >= 0, pixel, -1).astype(np.int32)

    @cached_property
    def densities(self) -> dict[str, Float[np.ndarray, "views 1 h w"]]:
        """What one event of every sensor pixel lays into each model pixel, `bilinear`, `nearest`.

        It ripples where views are resampled; a grid over it is in events per sensor pixel.
        """
        y, x = np.nonzero(self.view >= 0)
        time, one = np.zeros(len(x), np.int64), np.ones(len(x), np.int8)
        grids = {"bilinear": self.empty(1), "nearest": self.empty(1)}
        for kind, grid in grids.items():
            splat(time, x, y, one, self.view, self.place, grid, 0.0, 1.0, kind == "nearest")
        return {kind: np.maximum(grid, THINNEST) for kind, grid in grids.items()}

    @cached_property
    def unit(self) -> Float[np.ndarray, "views 1 h w"]:
        """Ones: no density."""
        return np.ones((self.views, 1, *self.model), np.float32)

    def check(self, events: np.ndarray) -> None:
        """Raise ValueError where an event lies off the sensor."""
        height, width = self.view.shape
        if events.size and (events["x"].max() >= width or events["y"].max() >= height):
            reach = int(events["x"].max()), int(events["y"].max())
            raise ValueError(
                f"events must lie on the {width}x{height} sensor of views, got (x, y) up to {reach}"
            )


def build(views: Views) -> Lookup:
    """Return the lookup of `views`; where two overlap, the one whose middle is nearer wins."""
    height, width = views.sensor
    y, x = np.mgrid[:height, :width].astype(np.float64)
    sensor = np.stack([x, y], axis=-1)
    best = np.full((height, width), np.inf)
    owner = np.full((height, width), -1, np.int16)
    place = np.zeros((height, width, 2), np.float32)
    middle = (np.array(views.model[::-1]) - 1) / 2
    half = np.array(views.model[::-1]) / 2
    for index, view in enumerate(views.views):
        matrix = views.to_model(view)
        uv = cv2.perspectiveTransform(sensor, matrix)
        front = _in_front(matrix, sensor, views.outline(view).mean(0))
        distance = np.abs((uv - middle) / half).max(-1)
        mine = front & (distance <= 1) & (distance < best)
        best[mine], owner[mine], place[mine] = distance[mine], index, uv[mine]
    return Lookup(owner, place, len(views.views), views.model)


def _in_front(matrix: np.ndarray, sensor: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Pixels on the view's side of the homography's horizon, beyond which the plane comes again."""
    depth = sensor @ matrix[2, :2] + matrix[2, 2]
    return depth * (centre @ matrix[2, :2] + matrix[2, 2]) > 0
