"""What the sides of a sensor may be, by itself: it is read without the readers of recordings."""

from collections.abc import Iterable

import numpy as np

LARGEST_SIDE = 8192  # pixels


def are_sensor_sides(sides: Iterable[int | np.integer]) -> bool:
    """Return whether all are in 1..LARGEST_SIDE."""
    return all(1 <= side <= LARGEST_SIDE for side in sides)
