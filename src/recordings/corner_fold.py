"""The two halves of a corner view of a kaleidoscope.

Light reaches a corner view by two mirrors, on one side of a line through the corner in one order,
on the other in the other.  Mirrors that are not at a right angle turn the halves against each
other, by four times the error of the angle.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

Points = Float[np.ndarray, "n 2"]
MAX_ANGLE_RAD = 0.3


@dataclass(frozen=True)
class CornerFold:
    """Two halves about `corner`, that meet at the line from there through `towards`; (x, y) in
    pixels of the centre view.  The homography of the view is their mean: each half is turned by
    half of `angle_rad`, away from the line, so that what lies near the line is not seen.  Below 0:
    towards it, so that it is seen twice.  Raises ValueError for an angle beyond MAX_ANGLE_RAD, a
    number that is not finite or no line."""

    corner: tuple[float, float]
    towards: tuple[float, float]
    angle_rad: float = 0.0

    def __post_init__(self):
        numbers = *self.corner, *self.towards, self.angle_rad
        if not np.isfinite(numbers).all() or self.corner == self.towards:
            raise ValueError(f"views: fold must be finite, of two points, got {numbers}")
        if abs(self.angle_rad) > MAX_ANGLE_RAD:
            got = f"must be in -{MAX_ANGLE_RAD}..{MAX_ANGLE_RAD}, got {self.angle_rad}"
            raise ValueError(f"views: fold.angle_rad {got}")

    def turn_halves(self, points: Points) -> Points:
        """Return the places in the centre view of points under the view's homography."""
        return self.turn(points, self.angle_rad / 2)

    def turn_halves_back(self, points: Points) -> Points:
        """Return the inverse of `turn_halves`; what both halves or none show is in the nearer."""
        return self.turn(points, -self.angle_rad / 2)

    def signed_distance_px(self, points: Points) -> Float[np.ndarray, " n"]:
        """Return how far points lie from the line, in pixels; below 0 on the one side of it."""
        return self._signed_distance_px(points)

    def turn(self, points: np.ndarray, angle: float) -> np.ndarray:
        """Return the points of each half turned by `angle`, away from the line.

        Tests do not check the shapes, as this runs at every step of a fit.
        """
        x, y = (points - self.corner).T
        side = np.sign(self._signed_distance_px(points))
        sine, cosine = side * np.sin(angle), np.cos(angle)
        return np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1) + self.corner

    def _signed_distance_px(self, points: np.ndarray) -> np.ndarray:
        across, along = np.subtract(self.towards, self.corner)
        x, y = (points - self.corner).T
        return (across * y - along * x) / np.hypot(across, along)
