"""The field: the rectangle of the centre view that becomes the model picture."""

import warnings
from collections.abc import Sequence

import numpy as np

from src.recordings.views import MIN_SHARE_ON_SENSOR, HeightWidth, View, share_on_sensor

MARGIN = 0.04  # of a tile's side, cut off at each seam
SMALLEST_FIELD = 0.25  # of its side, where a view smaller than the centre one has parts alone
Rectangle = tuple[float, float, float, float]  # left, top, right, bottom


def cut_field(tile: Rectangle, model: HeightWidth, margin: float = MARGIN) -> Rectangle:
    """Return the largest rectangle of the model's aspect in the middle of `tile`, less `margin` of
    its side at each edge."""
    left, top, right, bottom = tile
    scale = min((right - left) / model[1], (bottom - top) / model[0]) * (1 - 2 * margin) / 2
    x, y = (left + right) / 2, (top + bottom) / 2
    across, along = scale * model[1], scale * model[0]
    return x - across, y - along, x + across, y + along


def shrink_field(field: Rectangle, views: Sequence[View], sensor: HeightWidth) -> Rectangle:
    """Return the field or, where a view has too little of it on the sensor, the largest about its
    middle that all views have whole, with a warning.  Raises ValueError for none of SMALLEST_FIELD.
    """
    share = min(share_on_sensor(view, field, sensor) for view in views)
    if share >= MIN_SHARE_ON_SENSOR:
        return field
    corners = np.array(field)
    middle = (corners + np.roll(corners, 2)) / 2
    for scale in np.arange(0.99, SMALLEST_FIELD, -0.01):
        left, top, right, bottom = (middle + scale * (corners - middle)).tolist()
        smaller = left, top, right, bottom
        if all(share_on_sensor(view, smaller, sensor) == 1 for view in views):
            line = f"views show the middle of the centre one only: the field is {scale:.0%} of it"
            warnings.warn(f"{line} along each side", stacklevel=3)
            return smaller
    worst = min(views, key=lambda view: share_on_sensor(view, field, sensor))
    raise ValueError(
        f"calibrate: view {worst.position} has {share:.0%} of the centre one on the sensor and less"
        f" than its middle {SMALLEST_FIELD:.0%} whole; make the centre view smaller, or cover"
        f" {worst.position}"
    )
