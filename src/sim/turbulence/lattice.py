"""Regular lattices over an endless picture, and interpolation between their nodes.

A lattice holds every `pitch`-th pixel, pixel 0 being the first of the frame, so that a crop uses
the same nodes as the frame.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True)
class Lattice:
    """The nodes along one axis that pixels start .. start + count - 1 need.

    `order` 1 interpolates linearly between two nodes, 3 by Lagrange's cubic through four.
    """

    start: int
    count: int
    pitch: int
    order: int

    @property
    def first(self) -> int:
        """The number of the first node; it lies on pixel first * pitch."""
        return self.start // self.pitch - (self.order == 3 and self.pitch > 1)

    @property
    def nodes(self) -> int:
        """How many there are."""
        if self.pitch == 1:
            return self.count
        last = (self.start + self.count - 1) // self.pitch + (2 if self.order == 3 else 1)
        return last + 1 - self.first

    @property
    def pixels(self) -> Int[Tensor, " nodes"]:
        """The pixels that the nodes lie on."""
        return (torch.arange(self.nodes) + self.first) * self.pitch

    @property
    def offset(self) -> int:
        """How many pixels the first pixel lies after the first node."""
        return self.start - self.first * self.pitch

    def weights(self) -> Float[Tensor, "count nodes"]:
        """Return the weight of every node in every pixel; rows sum to 1."""
        if self.pitch == 1:
            return torch.eye(self.count)
        pixel = torch.arange(self.count) + self.offset
        cell = torch.div(pixel, self.pitch, rounding_mode="floor")
        place = (pixel - cell * self.pitch).double() / self.pitch
        linear = torch.stack([1 - place, place], dim=-1)
        taps = cubic_taps(place) if self.order == 3 else linear
        near = torch.arange(-1, 3) if self.order == 3 else torch.arange(2)
        weights = torch.zeros(self.count, len(self.pixels), dtype=torch.float64)
        return weights.scatter_(1, cell[:, None] + near, taps).float()


def cubic_taps(place: Float[Tensor, " n"]) -> Float[Tensor, "n 4"]:
    """Return Lagrange's weights of the nodes -1, 0, 1, 2 at `place` in [0, 1]."""
    t = place
    return torch.stack(
        [
            -t * (t - 1) * (t - 2) / 6,
            (t + 1) * (t - 1) * (t - 2) / 2,
            -(t + 1) * t * (t - 2) / 2,
            (t + 1) * t * (t - 1) / 6,
        ],
        dim=-1,
    )
