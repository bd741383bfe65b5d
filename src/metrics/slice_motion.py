"""How far what a slice shows strays: its rows (frames, places) against each other, in places.

Without a truth: something still should stay where it is on average, something in uniform motion
should draw a straight line.  One place is one pixel where the slice is sampled pixel by pixel.
"""

import numpy as np
from jaxtyping import Float

ROUNDS = 5  # of least squares
REACH = 8.0  # largest shift that is believed, in places


def wander(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms shift of each row against the mean row, for a scene that stands still.

    Gradient least squares (Lucas & Kanade 1981) with gain and offset fitted; nan without contrast.
    """
    mean = rows.mean(0)
    if np.ptp(mean) < 1e-3:
        return float("nan")
    places = np.arange(len(mean))
    shifts = np.array([_shift(row, mean, places) for row in rows])
    return float(shifts.std())


def wander_of_all(film: Float[np.ndarray, "frames h w"], step: int) -> float:
    """Return the median wander over rows and columns of a scene that stands still, `step` pixels
    apart and as far from the border.  Raises ValueError where there is no such line.
    """
    inside = film[:, step : film.shape[1] - step, step : film.shape[2] - step]
    if step < 1 or 0 in inside.shape:
        raise ValueError(f"still must be in 1..{min(film.shape[1:]) // 2} pixels, got {step}")
    rows = [wander(inside[:, y]) for y in range(0, inside.shape[1], step)]
    columns = [wander(inside[:, :, x]) for x in range(0, inside.shape[2], step)]
    return float(np.nanmedian(rows + columns))


def of_still(film: Float[np.ndarray, "frames h w"], step: int) -> dict[str, float]:
    """Return of a scene that stands still `wander`, the median over lines `step` pixels apart,
    `contrast`, the standard deviation of a picture, and `flicker`, the mean change of a pixel from
    frame to frame over the contrast.
    """
    contrast = float(film.std((1, 2)).mean())
    flicker = float(np.abs(np.diff(film, axis=0)).mean()) / max(contrast, 1e-9)
    return {"wander": wander_of_all(film, step), "contrast": contrast, "flicker": flicker}


def of_slice(
    rows: Float[np.ndarray, "frames places"], kind: str, follow: str = "any"
) -> dict[str, float]:
    """Return `wander` and `straightness` of a slice along a `line`, a `circle` or a ray that turns
    with the scene (`spin`), in places.

    Nothing stands still on a circle, and nothing moves along such a ray.
    """
    values = {} if kind == "circle" else {"wander": wander(rows)}
    if kind != "spin":
        measure = turning if kind == "circle" else straightness
        values["straightness"] = measure(followed(rows, follow))
    return values


def followed(rows: Float[np.ndarray, "frames places"], follow: str) -> np.ndarray:
    """Return `rows` with nothing in them but what is `bright` or `dark` against the median in time;
    with `any`, as they are.  Raises ValueError for another word."""
    middle = np.median(rows, axis=0)
    kinds = {"any": rows, "bright": np.maximum(rows, middle), "dark": np.minimum(rows, middle)}
    if follow not in kinds:
        raise ValueError(f"follow must be one of {', '.join(kinds)}, got {follow}")
    return kinds[follow]


def _shift(row: np.ndarray, mean: np.ndarray, places: np.ndarray) -> float:
    shift = 0.0
    for _ in range(ROUNDS):
        moved = np.interp(places - shift, places, mean)
        design = np.stack([-np.gradient(moved), moved, np.ones_like(moved)], axis=1)
        step, gain, _ = np.linalg.lstsq(design, row, rcond=None)[0]
        if gain <= 0:
            break
        shift = float(np.clip(shift + step / gain, -REACH, REACH))
    return shift


def straightness(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms distance from a straight line of what moves along the slice.

    Its place is the centroid of what differs from the median in time by more than a third of the
    largest difference; frames that show nothing are left out.  nan with fewer than three left.
    """
    weight, time = _moving(rows)
    if len(time) < 3:
        return float("nan")
    return _from_line(time, (weight @ np.arange(rows.shape[1])) / weight.sum(1))


def turning(rows: Float[np.ndarray, "frames places"]) -> float:
    """Return the rms distance, in places, from uniform turning of what moves along a closed circle.

    As `straightness`, but the places go round: their angle is that of the centroid on the circle,
    or, where two ends of a stripe pass, of the centroid of the doubled angles.  Less than half a
    turn (a quarter for a stripe) between two frames that show something.
    """
    weight, time = _moving(rows)
    if len(time) < 3:
        return float("nan")
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
    line = np.polyval(np.polyfit(time, place, 1), time)
    return float(np.sqrt(np.mean((place - line) ** 2)))
