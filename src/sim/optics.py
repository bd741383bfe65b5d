"""The light field: how many views, where they stand, how each is mirrored, how well registered.

A view is its grid position (row, col) relative to the centre view, in units of the pitch of the
sub-apertures; rows count downwards.  Axes: see docs/conventions.md.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

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


def centre(positions: Sequence[Position]) -> int:
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

    `views`: see `layout`; `positions` overrides it with a list of (row, col).
    `misalignment_px`: standard deviation, per corner and axis, of the residual homography of every
    view but the centre one, in pixels; 0 is perfect registration.
    """

    views: int = 9
    positions: Sequence[Sequence[int]] | None = None  # a config has lists
    misalignment_px: float = 0.0

    def __post_init__(self):
        if self.misalignment_px < 0 or not math.isfinite(self.misalignment_px):
            raise ValueError(f"optics.misalignment_px must be >= 0, got {self.misalignment_px}")
        chosen = layout(self.views) if self.positions is None else self.positions
        positions = tuple((int(row), int(col)) for row, col in chosen)
        if len(positions) != self.views or len(set(positions)) != self.views:
            raise ValueError(
                f"optics.positions must be {self.views} different (row, col), got {positions}"
            )
        object.__setattr__(self, "positions", positions)

    @property
    def view_ids(self) -> list[int]:
        """The key of each view, in order."""
        return [view_id(position) for position in self.positions]

    @property
    def centre(self) -> int:
        """The index of the centre view."""
        return centre(self.positions)

    def only(self, positions: Sequence[Position]) -> "Optics":
        """Return these optics with the views at `positions` alone."""
        return replace(self, views=len(positions), positions=tuple(positions))

    def misalign(
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
        if self.misalignment_px == 0:
            return frames
        height, width = full_size or frames.shape[-2:]
        warped = frames.clone()
        for index, position in enumerate(self.positions):
            if position != (0, 0):
                own = noise.key(key, view_id(position), "misalignment")
                matrix = self._residual(own, height, width)
                warped[:, index] = _warp(frames[:, index], matrix, origin)
        return warped

    def _residual(self, key: int, height: int, width: int) -> Tensor:
        right, bottom = width - 1.0, height - 1.0
        corners = torch.tensor([[0, 0], [right, 0], [right, bottom], [0, bottom]])
        jitter = noise.normal(key, torch.arange(8)).reshape(4, 2) * self.misalignment_px
        return homography(corners, corners + jitter)


def homography(source: Float[Tensor, "4 2"], target: Float[Tensor, "4 2"]) -> Float[Tensor, "3 3"]:
    """Return the homography that maps four (x, y) points onto four others, float64."""
    points = (part.float().numpy() for part in (source, target))
    return torch.from_numpy(cv2.getPerspectiveTransform(*points))


def _warp(frames: Tensor, matrix: Tensor, origin: tuple[int, int]) -> Tensor:
    """Sample (n, frames, h, w) at the homography of each pixel's full-frame (x, y)."""
    height, width = frames.shape[-2:]
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    points = torch.stack([x + origin[1], y + origin[0], torch.ones_like(x)], dim=-1).double()
    mapped = points @ matrix.T
    mapped = mapped[..., :2] / mapped[..., 2:] - torch.tensor([origin[1], origin[0]])
    grid = (2 * mapped + 1) / torch.tensor([width, height]) - 1
    grid = grid.to(frames)[None].expand(len(frames), -1, -1, -1)
    return functional.grid_sample(frames, grid, padding_mode="border", align_corners=False)
