"""The position (row, col) of each view on the sensor, from where it shows the target."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from src.recordings.calibration.boards import Points
from src.recordings.views import MIN_SHARE_ON_SENSOR, HeightWidth
from src.sim.optics import Position

MAX_SLOPE = 0.45  # of rows to x and of columns to y, of an optic turned on the sensor
MISSING_LINE = 0.2  # a gap is two pitches from 1.7 on, as targets off the middle of views vary it
Places = Float[np.ndarray, " k"]


def assign_view_positions(targets: Sequence[Points], sensor: HeightWidth) -> list[Position]:
    """Return (row, col) from the centre view for the points of the target in each view: rows and
    columns apart, as views need not be square."""
    if not targets:
        return []
    centres = np.array([points.mean(0) for points in targets], dtype=np.float64)
    width, height = np.median([np.ptp(points, axis=0) for points in targets], axis=0)
    from_middle = centres - (np.array(sensor[::-1]) - 1) / 2
    x, y = np.linalg.solve(_find_directions(centres), from_middle.T)
    rows = _number_lines(y, float(height), sensor[0])
    cols = _number_lines(x, float(width), sensor[1])
    return [(int(row), int(col)) for row, col in zip(rows, cols, strict=True)]


def _find_directions(centres: Points) -> Float[np.ndarray, "2 2"]:
    """Return unit vectors along the rows and along the columns, as columns of a matrix: those of
    the nearest neighbours, or of x and y where there are none."""
    offsets = (centres[:, None] - centres).reshape(-1, 2)
    directions = np.eye(2)
    for axis in (0, 1):
        near = offsets[MAX_SLOPE * offsets[:, axis] > np.abs(offsets[:, 1 - axis])]
        if len(near):
            length = np.linalg.norm(near, axis=1)
            typical = np.median(near[length < 1.2 * length.min()], axis=0)
            directions[:, axis] = typical / np.linalg.norm(typical)
    return directions


def _number_lines(places: Places, target_size: float, side: int) -> Int[np.ndarray, " k"]:
    """Return the line of each place, in pixels from the middle of a sensor of `side` pixels; 0 is
    the centre one.

    Neighbours less than half a target apart are in one line: targets side by side do not overlap.
    """
    order = np.argsort(places)
    line = np.zeros(len(places), int)
    line[order] = np.cumsum(np.diff(places[order], prepend=places.min()) > target_size / 2)
    middles = np.array([places[line == each].mean() for each in range(line.max() + 1)])
    index = _index_lines(middles, side)
    return (index - _centre_index(middles, index, side))[line]


def _index_lines(middles: Places, side: int) -> Int[np.ndarray, " k"]:
    """Return 0, 1, ... for lines in order, without the numbers of lines that are not seen."""
    if len(middles) == 1:
        return np.zeros(1, int)
    gaps = np.diff(middles)
    beside = side - gaps[0] if len(gaps) == 1 else np.inf  # two lines leave a pitch, or more
    steps = np.round(gaps / min(gaps.min(), beside) - MISSING_LINE)
    return np.append(0, np.maximum(steps, 1).cumsum()).astype(int)


def _centre_index(middles: Places, index: Int[np.ndarray, " k"], side: int) -> int:
    """Return the index of the middle line; of an even number the one before the middle, as of
    `ViewAxis`, or the one behind where it is on the sensor's and a further line fits in."""
    last = int(index[-1])
    if last % 2 == 0:
        return last // 2
    pitch = (middles[-1] - middles[0]) / last
    off = -(middles[0] + middles[-1]) / 2 / pitch
    room = (side / 2 - middles[-1]) / pitch - 0.5
    return last // 2 + int(off > 0.25 and room >= MIN_SHARE_ON_SENSOR)
