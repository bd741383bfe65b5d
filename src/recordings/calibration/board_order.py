"""Which point of a board in one view is which in the centre one, by places and by colours.

A board turned by 180 degrees shows its points at the same places.  The squares of a checkerboard
with one odd and one even number of inner corners then change colour; of others nothing tells.
"""

import numpy as np
from jaxtyping import Float, UInt8

from src.recordings.calibration.boards import Checkerboard, Points, Target

MIN_COLOUR = 0.5  # correlation of the squares' brightness with black and white
Lattice = Float[np.ndarray, "rows cols 2"]


def shows_half_turn(target: Target) -> bool:
    """Return whether a view turned by 180 degrees can be told from an upright one."""
    return target.ordered or (isinstance(target, Checkerboard) and sum(target.shape) % 2 == 1)


def order_points_as_in_centre_view(
    model: Points, seen: Points, target: Target, mirrored: tuple[bool, bool],
    picture: UInt8[np.ndarray, "h w"],
) -> Points:  # fmt: skip
    """Order the points `seen` as those of the centre view, `model`, are: as its nearest symmetry,
    or turned by 180 degrees from it where the colours of squares say so."""
    lattice = model.reshape(*target.shape, 2)
    upright = _find_nearest_symmetry(lattice, seen, mirrored)
    if not shows_half_turn(target):
        return upright
    colours = [
        _correlate_colours(picture, each.reshape(lattice.shape)) for each in (model, upright)
    ]
    has_turned = colours[0] * colours[1] < 0 and min(map(abs, colours)) >= MIN_COLOUR
    return upright[::-1] if has_turned else upright


def _correlate_colours(picture: UInt8[np.ndarray, "h w"], corners: Lattice) -> float:
    """Return the correlation of the squares between inner corners with 1 for the first, -1 for its
    neighbours and so on: near 1 or -1, the colour of the first."""
    middles = (corners[1:, 1:] + corners[:-1, :-1] + corners[1:, :-1] + corners[:-1, 1:]) / 4
    x, y = np.rint(middles).astype(int).reshape(-1, 2).T
    brightness = picture[y, x].astype(np.float64)
    rows, cols = np.indices(middles.shape[:2])
    sign = 1.0 - 2 * ((rows + cols) % 2).ravel()
    both = np.stack([brightness, sign]) - [[brightness.mean()], [sign.mean()]]
    scale = np.sqrt((both**2).sum(1)).prod()
    return float(both[0] @ both[1] / max(scale, 1e-9))


def _find_nearest_symmetry(model: Lattice, seen: Points, mirrored: tuple[bool, bool]) -> Points:
    """Order the lattice `seen` as `model` (rows, cols, 2) is: the nearest of its symmetries."""
    upright = np.where(mirrored, -seen, seen).reshape(model.shape)
    upright, model = upright - upright.mean((0, 1)), model - model.mean((0, 1))
    best, fitting = np.inf, seen
    for turned in (False, True) if model.shape[0] == model.shape[1] else (False,):
        for rows, cols in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            order = np.arange(len(seen)).reshape(model.shape[:2])[::rows, ::cols]
            order = (order.T if turned else order).ravel()
            error = np.abs(upright.reshape(-1, 2)[order] - model.reshape(-1, 2)).sum()
            if error < best:
                best, fitting = error, seen[order]
    return fitting
