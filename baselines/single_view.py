"""What frozen single-view methods share: one view in, a declared output handling."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from src.models.layers import pad_to_multiple
from src.sim.optics import Position, centre, layout
from src.sim.voxel import normalise_nonzero

NORMALISE = ("none", "nonzero")
OUTPUT = ("none", "clip", "sigmoid")


class SingleView(nn.Module):
    """The centre view's voxel grids to frames; what lies between is a subclass's `reconstruct`.

    `normalise`: none, or nonzero, the non-zero entries standardised.  `output`: none, clip
    (training sees unclipped frames) or sigmoid.  Sides are padded to multiples of `multiple`.
    """

    views: int | None = None
    multiple = 1

    def __init__(self, bins: int, normalise: str, output: str):
        super().__init__()
        if normalise not in NORMALISE:
            raise ValueError(f"baseline.normalise must be one of {NORMALISE}, got {normalise}")
        if output not in OUTPUT:
            raise ValueError(f"baseline.output must be one of {OUTPUT}, got {output}")
        self.bins, self.normalise, self.output = bins, normalise, output

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame and the state; `positions`: (row, col) of each view, None: `layout`."""
        height, width = voxels.shape[-2:]
        seen, (top, left) = pad_to_multiple(self.see(voxels, positions), self.multiple)
        frame, state = self.reconstruct(seen, state)
        return self.finish(frame[..., top : top + height, left : left + width]), state

    def see(
        self, voxels: Float[Tensor, "n views bins h w"], positions: Sequence[Position] | None
    ) -> Float[Tensor, "n c h w"]:
        """Return what the first convolution is given: the centre view.

        Raises ValueError when the grid has another number of bins.
        """
        if voxels.shape[2] != self.bins:
            raise ValueError(f"bins must be {self.bins} for this network, got {voxels.shape[2]}")
        view = voxels[:, centre(positions or layout(voxels.shape[1]))]
        return normalise_nonzero(view) if self.normalise == "nonzero" else view

    def reconstruct(
        self, seen: Float[Tensor, "n c h w"], state: Any
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame before its handling, and the state."""
        raise NotImplementedError

    def finish(self, frame: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
        """Return the frame after the declared handling."""
        if self.output == "sigmoid":
            return frame.sigmoid()
        return frame.clamp(0, 1) if self.output == "clip" and not self.training else frame
