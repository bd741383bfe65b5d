"""The sides of a recording's sensor: what the user or the file states, and what the events show."""

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.files.event_file import EventFile, RawEvents, WidthHeight
from src.recordings.sensor_limits import LARGEST_SIDE, are_sensor_sides

WIDEST = 4096  # pixels of a sensor
SWAPPED_SHARE = 0.01  # of the first events outside that show width and height exchanged
MOST_OUTSIDE = 0.5  # of all events, from which on a recording is refused


def check_sensor_size(given: Any) -> WidthHeight:
    """Return `given`, (height, width), as (width, height); raises ValueError unless it is two whole
    numbers in 1..LARGEST_SIDE."""
    sides = list(given) if isinstance(given, Sequence | np.ndarray) else []
    is_whole = all(isinstance(side, int | np.integer) for side in sides)
    if len(sides) != 2 or not is_whole or not are_sensor_sides(sides):
        wanted = f"(height, width), whole numbers in 1..{LARGEST_SIDE}"
        raise ValueError(f"sensor_size must be {wanted}, got {given}")
    return int(sides[1]), int(sides[0])


def find_swapped_size(file: EventFile, pieces: Iterable[RawEvents]) -> WidthHeight | None:
    """Return the file's (height, width) where more than SWAPPED_SHARE of the first of `pieces` lie
    outside (width, height) and all of them fit the exchanged sides; else None."""
    if file.size is None or file.size[0] == file.size[1]:
        return None
    first = next(iter(pieces), None)
    if first is None or not len(first.t):
        return None
    width, height = file.size
    outside = np.mean((first.x >= width) | (first.y >= height))
    if outside <= SWAPPED_SHARE or first.x.max() >= height or first.y.max() >= width:
        return None
    return height, width


def describe_oversized_coordinates(file: EventFile, pieces: Iterable[RawEvents]) -> tuple[str, ...]:
    """Return a line for the user where the first of `pieces` of a file that states no size has
    coordinates beyond WIDEST; else none."""
    first = next(iter(pieces), None) if file.size is None else None
    if first is None or not len(first.t):
        return ()
    x, y = int(first.x.max()), int(first.y.max())
    if max(x, y) < WIDEST:
        return ()
    told = f"x and y are up to {x} and {y}, beyond any sensor"
    parts = "parts of a pixel, such as 1/32 of BS-ERGB, are read only beside its images"
    return (f"{file.path}: {told}; {parts}",)


def choose_size(
    path: Path, given: WidthHeight | None, stated: WidthHeight | None, swapped: WidthHeight | None
) -> tuple[WidthHeight | None, tuple[str, ...]]:
    """Return the (width, height) that is read, and lines for the user.

    `given` by the user comes before what the events show (`swapped`) and what the file states.
    Raises ValueError for sides out of range.
    """
    size = given or swapped or stated
    if size is None:
        return None, ()
    if not are_sensor_sides(size):
        raise ValueError(f"{path}: a sensor's sides must be in 1..{LARGEST_SIDE}, got {size}")
    if stated in (None, size):
        return size, ()
    (width, height), said = size, f"{path}: states a sensor of {_text(stated)}"
    if size == swapped:
        said += f", its events fit {_text(size)}"
    return size, (f"{said}: read as sensor_size=[{height},{width}]",)


def report_events_outside(
    path: Path, size: WidthHeight, count: int, outside: int, largest_xy: np.ndarray
) -> None:
    """Warn of `outside` events of `count` beyond the sensor; raise ValueError where they are
    MOST_OUTSIDE or more.  `largest_xy`: of all events."""
    if not outside:
        return
    (width, height), (x, y) = size, largest_xy + 1
    if outside >= MOST_OUTSIDE * count:
        share = f"all {count}" if outside == count else f"{outside} of {count}"
        raise ValueError(
            f"{path}: {share} events are off the {_text(size)} sensor, they need {x}x{y}; "
            "is sensor_size=[height,width] right, and the file whole?"
        )
    exchanged = f"; all fit {height}x{width}, sensor_size=[{width},{height}]"
    fits = exchanged if x <= height and y <= width else ""
    line = f"{path}: {outside} of {count} events outside {_text(size)}, dropped{fits}"
    warnings.warn(line, stacklevel=2)


def _text(size: WidthHeight | None) -> str:
    return "x".join(map(str, size or ()))
