"""The light field: how many views and where they stand.

A view is its grid position (row, col) relative to the centre view, in units of the pitch of the
sub-apertures; rows count downwards.  Axes: see docs/conventions.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from numbers import Integral, Real
from operator import index
from typing import Any

from torch import Tensor

Position = tuple[int, int]
REACH = 8  # a grid position lies in -REACH..REACH

SPARSE_LAYOUTS: dict[int, tuple[Position, ...]] = {
    2: ((0, 0), (0, 1)),
    3: ((0, -1), (0, 0), (0, 1)),
    5: ((-1, 0), (0, -1), (0, 0), (0, 1), (1, 0)),
}


def layout(views: int) -> tuple[Position, ...]:
    """Return the positions of `views` views, row by row: 1, 2, 3, 5 (a cross) or a full square.

    An odd square has its centre view at (0, 0); an even one has (0, 0) up and left of its centre.
    Raises ValueError for a number without a layout.
    """
    try:
        number = index(views)  # of a tensor too, as traced
    except TypeError:
        number = 0
    if number in SPARSE_LAYOUTS:
        return SPARSE_LAYOUTS[number]
    side = math.isqrt(max(number, 0))
    if side * side != number or not 1 <= side <= 2 * REACH:
        allowed = f"1, 2, 3, 5 or a square up to {4 * REACH**2} (in commands: optics.views)"
        raise ValueError(f"views must be {allowed}, got {views!r}")
    first = -((side - 1) // 2)
    axis = range(first, first + side)
    return tuple((row, col) for row in axis for col in axis)


def is_arranged_as_layout(positions: Sequence[Position]) -> bool:
    """Return whether `positions` stand to each other, in order, as those of `layout`, whatever
    their spacing; True where their number has no layout."""
    try:
        wanted = layout(len(positions))
    except ValueError:
        return True
    return _axis_ranks(positions) == _axis_ranks(wanted)


def _axis_ranks(positions: Sequence[Position]) -> list[list[int]]:
    axes = [[int(position[axis]) for position in positions] for axis in range(2)]
    return [[sorted(set(places)).index(place) for place in places] for places in axes]


def most_central_view_index(positions: Sequence[Position]) -> int:
    """Return the index of the view nearest to (0, 0): what one camera alone would see."""
    return min(range(len(positions)), key=lambda i: sum(axis**2 for axis in positions[i]))


def check_positions(positions: Any, views: int | None = None) -> None:
    """Raise ValueError unless `positions` are pairs (row, col) of numbers, one for each of `views`;
    None: however many."""
    try:
        fits = all(_is_pair(pair, Real, Tensor) for pair in positions)
    except TypeError:
        fits = False
    if not fits:
        raise ValueError(f"positions must be the (row, col) of each view, got {positions}")
    if views not in (None, len(positions)):
        got = f"{len(positions)}: {list(positions)}"
        raise ValueError(f"positions must be {views} (row, col), one for each view, got {got}")


def _is_pair(value: Any, *kinds: type) -> bool:
    has_two = hasattr(value, "__len__") and len(value) == 2
    return has_two and all(isinstance(v, kinds) and not isinstance(v, bool) for v in value)


def check_reach(position: Position) -> None:
    """Raise ValueError for a grid position beyond REACH."""
    if max(map(abs, position)) > REACH:
        raise ValueError(f"optics.positions must lie in -{REACH}..{REACH}, got {position}")


def view_id(position: Position) -> int:
    """Return the number that keys the random draws of the view at `position` (centre: 144)."""
    check_reach(position)
    row, col = position
    return (row + REACH) * (2 * REACH + 1) + col + REACH


@dataclass(frozen=True)
class Optics:
    """Number and arrangement of the views: `views`, see `layout`, or `positions` (row, col)."""

    views: int = 9
    positions: Sequence[Any] = ()  # of (row, col)

    def __post_init__(self):
        chosen = self.positions or layout(self.views)
        if not (isinstance(chosen, Sequence) and all(_is_pair(one, Integral) for one in chosen)):
            allowed = "a list of (row, col), whole numbers"
            raise ValueError(f"optics.positions must be {allowed}, got {chosen}")
        positions = tuple((int(row), int(col)) for row, col in chosen)
        if len(positions) != self.views or len(set(positions)) != self.views:
            allowed = f"{self.views} different (row, col)"
            raise ValueError(f"optics.positions must be {allowed}, got {positions}")
        for position in positions:
            check_reach(position)
        object.__setattr__(self, "positions", positions)

    @property
    def random_key_ids(self) -> list[int]:
        return [view_id(position) for position in self.positions]

    @property
    def centre(self) -> int:
        return most_central_view_index(self.positions)

    def select_views(self, positions: Sequence[Position]) -> "Optics":
        """Return these optics with the views at `positions` alone."""
        return replace(self, views=len(positions), positions=tuple(positions))
