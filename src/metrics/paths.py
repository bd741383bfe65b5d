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
    away = np.abs(rows - np.median(rows, axis=0))
    weight = np.clip(away - away.max() / 3, 0, None)
    seen = weight.sum(1) > 0
    if seen.sum() < 3:
        return float("nan")
    place = (weight[seen] @ np.arange(rows.shape[1])) / weight[seen].sum(1)
    time = np.flatnonzero(seen)
    line = np.polyval(np.polyfit(time, place, 1), time)
    return float(np.sqrt(np.mean((place - line) ** 2)))
