"""What a grid of views leaves out: views that show next to nothing, and events in no view."""

import warnings
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from src.recordings.calibration.activity_pictures import Pictures, measure_squared_contrast
from src.recordings.calibration.view_grid import ViewAxis, ViewGrid
from src.sim.optics import Position

DARK = 0.05  # of the squared contrast of the median view; a blocked view has 0.004 at most
MIN_OTHERS = 2  # views beside the centre one, where some are left out
LIT, PART = 0.5, 0.5  # of a view's events per pixel, and of its width or height
Map = Float[np.ndarray, "h w"]


def leave_out_blocked_views(grid: ViewGrid, pictures: Pictures) -> ViewGrid:
    """Return the grid without the views that show next to nothing; warn of them, but for rows and
    columns of margins (`_trim_dark_margins`).

    Raises ValueError where the centre view is one, or fewer than MIN_OTHERS others are left.
    """
    squares, step = measure_squared_contrast(pictures)
    shown = {at: _view_mean(squares.sum(0), grid, at, step) for at in grid.positions}
    least = DARK * float(np.median(list(shown.values())))
    dark = [at for at, contrast in shown.items() if contrast < least]
    if not dark:
        return grid
    names = " and ".join(map(str, dark))
    if (0, 0) in dark or len(shown) - len(dark) <= MIN_OTHERS:
        raise ValueError(
            f"recording must show the centre view and {MIN_OTHERS} others: next to nothing is seen"
            f" in {names} of {len(shown)} views, which may be blocked"
        )
    grid = _trim_dark_margins(grid, dark)
    if blocked := tuple(at for at in dark if at in grid.positions):
        names = " and ".join(map(str, blocked))
        warnings.warn(f"next to nothing is seen in view {names}, which is left out", stacklevel=3)
    return replace(grid, left_out=blocked)


def _trim_dark_margins(grid: ViewGrid, dark: list[Position]) -> ViewGrid:
    """Return the grid without its first and last row, and column, while all views of both are
    `dark`: there the sensor goes on beyond the views."""
    for name, side in (("y", 0), ("x", 1)):
        axis = getattr(grid, name)
        while {at for at in grid.positions if at[side] in axis.outer_offsets} <= {*dark}:
            axis = replace(axis, start=axis.start + axis.pitch, count=axis.count - 2)
            grid = replace(grid, **{name: axis})
    return grid


def share_of_events_outside_views(grid: ViewGrid, pictures: Pictures) -> float:
    """Return the share of the events that lie in no view; warn where parts of views, or smaller
    ones, are left out beside a row or column."""
    events = pictures.sum((0, 1))
    inside = events[_span(grid.y), _span(grid.x)]
    share = 1 - float(inside.sum() / events.sum())
    if beside := _list_lit_sides(grid, events):
        warnings.warn(
            f"{describe_grid(grid, share)}: left out {' and '.join(beside)}; views must be whole"
            " and of one size within 10 %, a board (target=) finds others",
            stacklevel=2,
        )
    return share


def describe_grid(grid: ViewGrid, in_no_view: float) -> str:
    """Return how many views there are and the share of the events in none, for a person."""
    found = f"{grid.y.count} rows x {grid.x.count} columns of views"
    return f"{found}, {in_no_view:.0%} of the events in none"


def _list_lit_sides(grid: ViewGrid, events: Map) -> list[str]:
    rows, cols = _span(grid.y), _span(grid.x)
    least = LIT * events[rows, cols].mean()
    sides = (
        ("above", grid.y, events[: rows.start, cols]),
        ("below", grid.y, events[rows.stop :, cols]),
        ("left", grid.x, events[rows, : cols.start]),
        ("right", grid.x, events[rows, cols.stop :]),
    )
    lit = []
    for name, axis, strip in sides:
        length = strip.shape[0 if axis is grid.y else 1] / axis.pitch
        if axis.count > 1 and length >= PART and strip.mean() >= least:
            lit.append(f"{length:.2f} of a view {name}")
    return lit


def _span(axis: ViewAxis) -> slice:
    first = max(0, round(axis.start + 0.5))
    return slice(first, round(axis.start + 0.5 + axis.count * axis.pitch))


def _view_mean(picture: Map, grid: ViewGrid, at: Position, step: int) -> float:
    """Return the mean over the middle half of a view of a picture shrunk by `step`."""
    middle = []
    for axis, offset in ((grid.y, at[0]), (grid.x, at[1])):
        begin, end = axis.centre_view_edges
        first, last = (int((b + offset * axis.pitch) / step) for b in (begin, end))
        edge = round((last - first) / 4)
        middle.append(slice(max(0, first) + edge, last - edge))
    return float(picture[middle[0], middle[1]].mean())
