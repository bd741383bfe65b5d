"""Shapes drawn analytically: what share of each pixel they cover, for any position between pixels.

Coordinates are pixels, the centre of a pixel is a whole number, y points down, angles are radians
and grow clockwise as seen.
"""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

Map = Float[np.ndarray, "..."]


def inside(depth: Map) -> Map:
    """Return the share of a pixel that is inside, from how deep (px) its centre lies inside.

    Exact for edges along rows or columns, off by at most 0.05 for slanting ones.
    """
    return np.clip(depth + 0.5, 0, 1)


def disc(x: Map, y: Map, radius: float) -> Map:
    """Return the share of the pixels at (x, y), seen from its centre, that a disc covers.

    Its centre of mass is off by 0.01 px rms at a radius of 3 px, 0.005 px at 13 px (measured).
    """
    return inside(radius - np.hypot(x, y))


def stripes(place: Map, width: float) -> Map:
    """Return the mean over a pixel of stripes of +1 (from 0 on) and -1, each `width` wide; exact
    where the stripes run along rows or columns.
    """

    def integral(x: Map) -> Map:
        return width - abs(x % (2 * width) - width)

    return integral(place + 0.5) - integral(place - 0.5)


def sectors(x: Map, y: Map, number: int) -> Map:
    """Return the share of the pixels at (x, y), seen from the middle of a disc, in one of `number`
    equal sectors, the first from angle 0 on, with gaps as wide between; off by at most 0.05 except
    within `number` pixels of the middle.
    """
    wide = math.pi / number
    from_middle = abs((np.arctan2(y, x) + wide / 2) % (2 * wide) - wide)  # of the nearest sector
    return inside(np.hypot(x, y) * np.sin(wide / 2 - from_middle))


def turned(x: Map, y: Map, angle: float) -> tuple[Map, Map]:
    """Return the coordinates (x, y) along and across a body that lies at `angle`."""
    cos, sin = math.cos(angle), math.sin(angle)
    return cos * x + sin * y, cos * y - sin * x


def polar(
    centre: Sequence[float] | Float[np.ndarray, "2"], radius: float, angle: float
) -> tuple[float, float]:
    """Return the point (x, y) at `radius` and `angle` from `centre`."""
    return centre[0] + radius * math.cos(angle), centre[1] + radius * math.sin(angle)
