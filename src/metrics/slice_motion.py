"""Motion in a space-time slice (frames, places) without ground truth.  What is static should keep
its mean place, what moves uniformly should draw a straight line.
"""

import numpy as np
from jaxtyping import Float, Num

ITERATIONS = 5  # of least squares
MAX_SHIFT = 8.0  # places
MIN_CORRELATION = 0.5  # of a row with the shifted mean row; below, the row does not show the scene
MOST_LOST = 0.5  # of the rows
SLICES = ("line", "circle", "spin")


def residual_displacement_px(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms shift of each row against the mean row, for a static scene.

    Gradient least squares (Lucas & Kanade 1981) with gain and offset fitted, shifts cut at
    MAX_SHIFT.  Rows that do not show the scene are left out; nan without contrast and where more
    than MOST_LOST of them do not.
    """
    mean = rows.mean(0)
    if np.ptp(mean) < 1e-3:
        return float("nan")
    shifts = np.array([_shift(row, mean) for row in rows])
    shown = shifts[np.isfinite(shifts)]
    return float(np.std(shown)) if len(shown) >= MOST_LOST * len(shifts) else float("nan")


def _shift(row: np.ndarray, mean: np.ndarray) -> float:
    shift, places = 0.0, np.arange(len(mean))
    for _ in range(ITERATIONS):
        moved = np.interp(places - shift, places, mean)
        design = np.stack([-np.gradient(moved), moved, np.ones_like(moved)], axis=1)
        step, gain, _ = np.linalg.lstsq(design, row, rcond=None)[0]
        if gain <= 0:
            return float("nan")
        shift = float(np.clip(shift + step / gain, -MAX_SHIFT, MAX_SHIFT))
    is_shown = correlation(np.interp(places - shift, places, mean), row) > MIN_CORRELATION
    return shift if is_shown else float("nan")


def correlation(a: Float[np.ndarray, "*size"], b: Float[np.ndarray, "*size"]) -> float:
    """Return the correlation of two arrays of one size; 0 where one has no contrast."""
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return 0.0
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def measure_static_scene(
    film: Num[np.ndarray, "frames h w"], line_spacing_px: int
) -> dict[str, float]:
    """Return `residual_displacement_px` of a static scene, the median over rows and columns
    `line_spacing_px` apart and as far from the border (nan where none shows the scene), `contrast`,
    the standard deviation of a frame, and `flicker`, the mean change of a pixel from frame to frame
    over the contrast: nan of a blank film.

    Raises ValueError where there is no such row or column.
    """
    film, step = np.asarray(film, float), line_spacing_px  # differences of uint8 would wrap
    inside = film[:, step : film.shape[1] - step, step : film.shape[2] - step]
    if step < 1 or 0 in inside.shape:
        raise ValueError(f"still must be in 1..{(min(film.shape[1:]) - 1) // 2} pixels, got {step}")
    lines = [inside[:, y] for y in range(0, inside.shape[1], step)]
    lines += [inside[:, :, x] for x in range(0, inside.shape[2], step)]
    contrast = float(film.std((1, 2)).mean())
    change = float(np.abs(np.diff(film, axis=0)).mean())
    shown = [value for value in map(residual_displacement_px, lines) if np.isfinite(value)]
    return {
        "residual_displacement_px": float(np.median(shown)) if shown else float("nan"),
        "contrast": contrast,
        "flicker": change / contrast if contrast > 0 else float("nan"),
    }


def measure_slice_motion(
    rows: Float[np.ndarray, "frames places"], kind: str, object_brightness: str = "any"
) -> dict[str, float]:
    """Return `residual_displacement_px` and `line_deviation_px` of a slice along a `line`, a
    `circle` or a ray that turns with the scene (`spin`), in places.

    Nothing is static on a circle, and nothing moves along such a ray.  `object_brightness`: whether
    what moves is `bright` or `dark` against the median in time, or `any`.  Raises ValueError for
    another of either.
    """
    if kind not in SLICES:
        raise ValueError(f"kind must be one of {', '.join(SLICES)}, got {kind}")
    values = {}
    if kind != "circle":
        values["residual_displacement_px"] = residual_displacement_px(rows)
    if kind != "spin":
        measure = uniform_rotation_deviation_px if kind == "circle" else line_deviation_px
        values["line_deviation_px"] = measure(_isolate_moving(rows, object_brightness))
    return values


def _isolate_moving(rows: np.ndarray, object_brightness: str) -> np.ndarray:
    middle = np.median(rows, axis=0)
    kinds = {"any": rows, "bright": np.maximum(rows, middle), "dark": np.minimum(rows, middle)}
    if object_brightness not in kinds:
        allowed = ", ".join(kinds)
        raise ValueError(
            f"moving_object_brightness must be one of {allowed}, got {object_brightness}"
        )
    return kinds[object_brightness]


def line_deviation_px(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms distance from a straight line of what moves along the slice.

    Its place is the centroid of what differs from the median in time by more than a third of the
    largest difference; frames that show nothing are left out.  nan with fewer than three left.
    """
    weight, time = _moving(rows)
    return _from_line(time, (weight @ np.arange(rows.shape[1])) / weight.sum(1))


def uniform_rotation_deviation_px(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms distance, in places, from uniform rotation of what moves along a circle.

    As `line_deviation_px`, but places are periodic: their angle is that of the centroid on the
    circle, or, where two ends of a stripe pass, of the centroid of the doubled angles.  Less than
    half a turn (a quarter for a stripe) between two frames that show something.
    """
    weight, time = _moving(rows)
    angle = 2 * np.pi * np.arange(rows.shape[1]) / rows.shape[1]
    once, twice = ((weight @ np.exp(1j * k * angle)) for k in (1, 2))
    ends = 1 if abs(once).sum() >= 0.5 * abs(twice).sum() else 2
    turned = np.unwrap(np.angle(once if ends == 1 else twice)) / ends
    return _from_line(time, turned * rows.shape[1] / (2 * np.pi))


def _moving(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the weight of what moves, in the frames that show it, and the numbers of these."""
    away = np.abs(rows - np.median(rows, axis=0))
    weight = np.clip(away - away.max() / 3, 0, None)
    time = np.flatnonzero(weight.sum(1) > 0)
    return weight[time], time


def _from_line(time: np.ndarray, place: np.ndarray) -> float:
    if len(time) < 3:
        return float("nan")
    line = np.polyval(np.polyfit(time, place, 1), time)
    return float(np.sqrt(np.mean((place - line) ** 2)))
