"""The light field: how many views, where they stand, how each is mirrored, how well registered.

A view is its grid position (row, col) relative to the centre view, in units of the pitch of the
sub-apertures; rows count downwards.  Axes: see docs/conventions.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise

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
    if views in SPARSE_LAYOUTS:
        return SPARSE_LAYOUTS[views]
    side = math.isqrt(max(views, 0))
    if side * side != views or not 1 <= side <= 2 * REACH:
        allowed = f"1, 2, 3, 5 or a square up to {4 * REACH**2}"
        raise ValueError(f"optics.views must be {allowed}, got {views}")
    first = -((side - 1) // 2)
    axis = range(first, first + side)
    return tuple((row, col) for row in axis for col in axis)


def centre_view_index(positions: Sequence[Position]) -> int:
    """Return the index of the view nearest to (0, 0): what one camera alone would see."""
    return min(range(len(positions)), key=lambda i: sum(axis**2 for axis in positions[i]))


def view_id(position: Position) -> int:
    """Return the number that keys the random draws of the view at `position` (centre: 144)."""
    row, col = position
    if max(abs(row), abs(col)) > REACH:
        raise ValueError(f"optics.positions must lie in -{REACH}..{REACH}, got {position}")
    return (row + REACH) * (2 * REACH + 1) + col + REACH


@dataclass(frozen=True)
class Optics:
    """Number and arrangement of the views and what registration leaves wrong.

    `views`: see `layout`; `positions` overrides it with (row, col), if any.
    `homography_error_px`: standard deviation, per corner and axis, of the residual homography of
    every view but the centre one, in pixels; 0 is perfect registration.
    """

    views: int = 9
    positions: Sequence[Any] = ()  # of (row, col)
    homography_error_px: float = 0.0

    def __post_init__(self):
        if self.homography_error_px < 0 or not math.isfinite(self.homography_error_px):
            raise ValueError(
                f"optics.homography_error_px must be >= 0, got {self.homography_error_px}"
            )
        chosen = self.positions or layout(self.views)
        positions = tuple((int(row), int(col)) for row, col in chosen)
        if len(positions) != self.views or len(set(positions)) != self.views:
            allowed = f"{self.views} different (row, col)"
            raise ValueError(f"optics.positions must be {allowed}, got {positions}")
        object.__setattr__(self, "positions", positions)

    @property
    def random_key_ids(self) -> list[int]:
        return [view_id(position) for position in self.positions]

    @property
    def centre(self) -> int:
        return centre_view_index(self.positions)

    def select_views(self, positions: Sequence[Position]) -> "Optics":
        """Return these optics with the views at `positions` alone."""
        return replace(self, views=len(positions), positions=tuple(positions))

    def apply_homography_error(
        self,
        frames: Float[Tensor, "n views frames h w"],
        key: int,
        *,
        origin: tuple[int, int] = (0, 0),
        full_size: tuple[int, int] | None = None,
    ) -> Float[Tensor, "n views frames h w"]:
        """Warp every view but the centre one by its residual homography (bilinear).

        `origin` is the (row, column) of the first pixel in the full frame of `full_size` (h, w), so
        that a crop is warped as the full frame is.  The homography is a function of (key, view).
        """
        if self.homography_error_px == 0:
            return frames
        from kornia.geometry.transform import warp_perspective  # here: to import it takes a second

        height, width = full_size or frames.shape[-2:]
        shift = torch.eye(3, dtype=torch.float64)
        shift[:2, 2] = torch.tensor([-origin[1], -origin[0]])
        warped = frames.clone()
        for index, position in enumerate(self.positions):
            if position == (0, 0):
                continue
            view_key = noise.key(key, view_id(position), "misalignment")
            seen = self._draw_homography(view_key, height, width).inverse()  # frame to view
            matrix = (shift @ seen @ shift.inverse()).to(frames.device).expand(len(frames), -1, -1)
            view, size = frames[:, index].double(), (frames.shape[-2], frames.shape[-1])
            warped[:, index] = warp_perspective(view, matrix, size, padding_mode="border")
        return warped

    def _draw_homography(self, key: int, height: int, width: int) -> Float[Tensor, "3 3"]:
        """Return the homography, float64, that moves each corner at random."""
        right, bottom = width - 1.0, height - 1.0
        corners = torch.tensor([[0, 0], [right, 0], [right, bottom], [0, bottom]])
        moved = (
            corners + noise.normal(key, torch.arange(8)).reshape(4, 2) * self.homography_error_px
        )
        return torch.from_numpy(cv2.getPerspectiveTransform(corners.numpy(), moved.numpy()))
