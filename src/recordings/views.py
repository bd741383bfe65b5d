"""Several views on one sensor: where each lies and how it is mirrored, as a readable file.

Each view has a homography from its sensor pixels to those of the centre view; a rectangle of that,
the field, becomes the model picture.  Sizes are (height, width).  Pixel (0, 0) is the centre of the
top left pixel; x runs right, y down.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import Float

from src.recordings.corner_fold import CornerFold, Points
from src.recordings.files.event_file import HeightWidth
from src.recordings.sensor_limits import LARGEST_SIDE, are_sensor_sides
from src.records import safe_yaml
from src.records.atomic import write_text

MAX_PIXELS = 2**24  # of a sensor, and of all views' pictures together
MIN_SHARE_ON_SENSOR = 0.75  # of a view


@dataclass(frozen=True, eq=False)
class View:
    """One sub-aperture: grid position (row, col) relative to the centre view and its homography,
    from sensor pixels (x, y, 1) to those of the centre view (determinant < 0: mirrored).
    `error_px`: rms residual of the `points` it was fitted to, in pixels of the centre view.
    `fold`: of a corner view, the halves that mirrors which are not at a right angle turn."""

    position: tuple[int, int]
    homography: Float[np.ndarray, "3 3"]
    error_px: float = 0.0
    points: int = 0
    fold: CornerFold | None = None

    def to_centre(self, points: Points) -> Points:
        """Return the places in the centre view of sensor pixels of this one."""
        placed = _transform(self.homography, points)
        return self.fold.turn_halves(placed) if self.fold else placed

    def to_sensor(self, points: Points) -> Points:
        """Return the inverse of `to_centre`."""
        placed = self.fold.turn_halves_back(points) if self.fold else points
        return _transform(np.linalg.inv(self.homography), placed)


@dataclass(frozen=True, eq=False)
class Views:
    """The views of one sensor; `field` is the rectangle (left, top, right, bottom) of the centre
    view, in sensor pixels, that becomes the model picture.

    Raises ValueError where a size is out of range, a number is not finite, a position comes twice
    or less than three quarters of a view lies on the sensor."""

    sensor: HeightWidth
    model: HeightWidth
    field: tuple[float, float, float, float]
    views: tuple[View, ...]

    def __post_init__(self):
        _check_size("views.sensor", self.sensor)
        _check_size("views.model", self.model, len(self.views))
        left, top, right, bottom = self.field
        if not (np.isfinite(self.field).all() and right - left >= 1 and bottom - top >= 1):
            raise ValueError(f"views.field must be left, top, right, bottom, got {self.field}")
        at = self.positions
        if not at or len(set(at)) != len(at):
            raise ValueError(f"views.views must be one or more different positions, got {at}")
        for view in self.views:
            self._check(view)

    def _check(self, view: View) -> None:
        matrix = view.homography
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-9:
            at = view.position
            raise ValueError(f"views: homography of view {at} must be finite and regular")
        height, width = self.sensor
        share = share_on_sensor(view, self.field, self.sensor)
        if share < MIN_SHARE_ON_SENSOR:
            raise ValueError(
                f"views: view {view.position} must lie on the {width}x{height} sensor"
                f" by {MIN_SHARE_ON_SENSOR:.0%}, got {share:.0%}"
            )

    @classmethod
    def single_view(cls, sensor: HeightWidth, model: HeightWidth) -> "Views":
        """Return the whole sensor as one view, resampled to the model picture."""
        height, width = sensor
        whole = (-0.5, -0.5, width - 0.5, height - 0.5)
        return cls(sensor, model, whole, (View((0, 0), np.eye(3)),))

    @property
    def positions(self) -> list[tuple[int, int]]:
        return [view.position for view in self.views]

    def to_model(self, view: View, points: Points) -> Points:
        """Return the places in the model picture of sensor pixels of `view`."""
        left, top, right, bottom = self.field
        scale = np.array([self.model[1] / (right - left), self.model[0] / (bottom - top)])
        return view.to_centre(points) * scale - (scale * (left, top) + 0.5)

    def outline(self, view: View) -> Float[np.ndarray, "4 2"]:
        """Return the corners of `view` on the sensor: the field's, clockwise from top left."""
        return _field_on_sensor(view, self.field, 2)[[0, 1, 3, 2]]

    def mirrored_xy(self, view: View) -> tuple[bool, bool]:
        """Return whether `view` is mirrored in x and in y (both: it is turned by 180 degrees)."""
        corners = self.outline(view)
        return bool(corners[1, 0] < corners[0, 0]), bool(corners[3, 1] < corners[0, 1])

    def select(self, positions: Sequence[tuple[int, int]]) -> "Views":
        """Return the views at `positions`, in that order.  Raises ValueError for one not there."""
        by_position = dict(zip(self.positions, self.views, strict=True))
        missing = [position for position in positions if position not in by_position]
        if missing:
            raise ValueError(f"views has no view at {missing}, only {self.positions}")
        return replace(self, views=tuple(by_position[position] for position in positions))

    def warp_to_model(
        self, picture: Float[np.ndarray, "sensor_h sensor_w"]
    ) -> Float[np.ndarray, "views h w"]:
        """Return every view of one sensor picture in model pixels (bilinear, float32).

        Raises ValueError for a picture of another size than the sensor."""
        if picture.shape != tuple(self.sensor):
            wanted, got = ("x".join(map(str, size[::-1])) for size in (self.sensor, picture.shape))
            raise ValueError(f"views must be of a sensor of {got}, as the pictures, got {wanted}")
        (height, width), (left, top, right, bottom) = self.model, self.field
        x = left + (np.arange(width) + 0.5) * (right - left) / width
        y = top + (np.arange(height) + 0.5) * (bottom - top) / height
        flat, places = picture.astype(np.float32), list_grid_points(x, y)
        seen = (view.to_sensor(places) for view in self.views)
        return np.stack([sample_bilinear(flat, at, self.model) for at in seen])

    def save(self, path: Path | str) -> None:
        """Write a YAML file that `load_views` reads back exactly."""
        views = [
            {
                "position": list(view.position),
                "mirrored": list(self.mirrored_xy(view)),
                "error_px": round(view.error_px, 4),
                "points": view.points,
                "homography": view.homography.tolist(),
            }
            | ({"fold": asdict(view.fold)} if view.fold else {})
            for view in self.views
        ]
        content = {
            "sensor": list(self.sensor),
            "model": list(self.model),
            "field": [float(edge) for edge in self.field],
            "views": views,
        }
        style = {"sort_keys": False, "default_flow_style": None, "width": 100}
        write_text(Path(path), HEADER + yaml.safe_dump(content, **style))


HEADER = """\
# Views of one sensor. Sizes: [height, width]. Pixel (0, 0) is the centre of the top left pixel.
# field: [left, top, right, bottom] of the centre view, in sensor pixels, becomes the model picture.
# position: [row, col] relative to the centre view; mirrored: [in x, in y];
# homography: sensor pixels of this view -> sensor pixels of the centre view;
# error_px: rms residual over the calibration's points, sensor pixels of the centre view.
# fold: then turned about corner by angle_rad / 2, away from the line through towards, either side.
"""


def _check_size(key: str, size: HeightWidth, pictures: int = 1) -> None:
    """Raise ValueError, which names `key`, where so many pictures of `size` are too large."""
    if not are_sensor_sides(size):
        raise ValueError(f"{key} must be in 1..{LARGEST_SIDE} pixels, got {size}")
    if pictures * math.prod(size) > MAX_PIXELS:
        got = f"{pictures} x {size}" if pictures > 1 else f"{size}"
        raise ValueError(f"{key} must have {MAX_PIXELS} pixels at most, got {got}")


def views_or_whole_sensor(
    path: Path | str | None, sensor: HeightWidth, resolution: Sequence[int] | None = None
) -> Views:
    """Return the views of the file `path` or, without one, the whole sensor as one view.

    `resolution`: (height, width) of the model picture instead of that of the file or the sensor.
    Raises ValueError for one out of range."""
    if path is None:
        _check_size("sensor_size", sensor)
    views = load_views(path, sensor) if path is not None else Views.single_view(sensor, sensor)
    if not resolution:
        return views
    model = resolution[0], resolution[1]
    _check_size("resolution", model, len(views.views))
    return replace(views, model=model)


def load_views(path: Path | str, sensor: HeightWidth | None = None) -> Views:
    """Read a file of `Views.save` or one by hand (`mirrored`, `error_px`, `points` are optional).

    The views are put in order of position, row by row.

    Raises ValueError for what is no such file, a value out of range, a `mirrored` its homography
    contradicts, or another sensor than `sensor` (height, width)."""
    try:
        content = safe_yaml.read(path)
        entries = _get(content, "views")
        if not isinstance(entries, list):
            raise TypeError("expected a list of views")
        views = Views(
            _parse_numbers(_get(content, "sensor"), int, 2),
            _parse_numbers(_get(content, "model"), int, 2),
            _parse_numbers(_get(content, "field"), float, 4),
            tuple(map(_parse_view, entries)),
        )
        stated = [entry.get("mirrored") for entry in entries]
    except (OSError, yaml.YAMLError, TypeError, OverflowError) as error:
        fault = error.strerror if isinstance(error, OSError) else " ".join(str(error).split())
        got = f"{path or 'none'}: {fault}"
        raise ValueError(f"views must be a file of calibrate task=views, got {got}") from None
    for view, mirrored in zip(views.views, stated, strict=True):
        if mirrored not in (None, list(views.mirrored_xy(view))):
            raise ValueError(f"{path}: mirrored of {view.position} contradicts its homography")
    if sensor is not None and tuple(sensor) != views.sensor:
        raise ValueError(f"{path}: sensor must be the recording's {sensor}, got {views.sensor}")
    return replace(views, views=tuple(sorted(views.views, key=lambda view: view.position)))


def _get(entry: Any, key: str) -> Any:
    if not isinstance(entry, dict) or key not in entry:
        raise TypeError(f"no entry {key}")
    return entry[key]


def _parse_view(entry: Any) -> View:
    rows = _get(entry, "homography")
    if not isinstance(rows, list) or len(rows) != 3:
        raise TypeError("homography must have 3 rows")
    matrix = np.array([_parse_numbers(row, float, 3) for row in rows])
    (error,) = _parse_numbers([entry.get("error_px", 0.0)], float, 1)
    (points,) = _parse_numbers([entry.get("points", 0)], int, 1)
    fold = _parse_fold(entry["fold"]) if "fold" in entry else None
    return View(_parse_numbers(_get(entry, "position"), int, 2), matrix, error, points, fold)


def _parse_fold(entry: Any) -> CornerFold:
    ends = [_parse_numbers(_get(entry, end), float, 2) for end in ("corner", "towards")]
    return CornerFold(ends[0], ends[1], *_parse_numbers([_get(entry, "angle_rad")], float, 1))


def _parse_numbers(values: list, kind: type, count: int) -> tuple:
    numbers = isinstance(values, list) and len(values) == count
    if not numbers or any(type(value) not in (int, kind) for value in values):
        raise TypeError(f"expected a list of {count} x {kind.__name__}")
    return tuple(kind(value) for value in values)


def sample_bilinear(
    picture: Float[np.ndarray, "h w"], places: Points, out_size: HeightWidth
) -> np.ndarray:
    """Return `picture` at `places`, bilinear, 0 outside, as a picture of `out_size`."""
    x, y = places.T.astype(np.float32)
    return cv2.remap(picture, x.reshape(out_size), y.reshape(out_size), cv2.INTER_LINEAR)


def list_grid_points(x: np.ndarray, y: np.ndarray) -> Points:
    """Return the (x, y) of a grid, row by row, of its columns' x and its rows' y."""
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float64)


def share_on_sensor(view: View, field: Sequence[float], sensor: HeightWidth) -> float:
    """Return the share of the field's pixels that `view` has on a sensor of (height, width)."""
    x, y = _field_on_sensor(view, field, 9).T
    height, width = sensor
    return float(np.mean((x >= -0.5) & (x < width - 0.5) & (y >= -0.5) & (y < height - 0.5)))


def _field_on_sensor(view: View, field: Sequence[float], side: int) -> Points:
    x, y = np.linspace(field[:2], field[2:], side).T
    return view.to_sensor(list_grid_points(x, y))


def _transform(matrix: Float[np.ndarray, "3 3"], points: Points) -> Points:
    return cv2.perspectiveTransform(points[None], matrix)[0]
