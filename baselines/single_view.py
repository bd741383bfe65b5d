"""What frozen single-view methods share: one view in, a declared output handling."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from src.sim.optics import Position, centre, layout
from src.sim.voxel import normalise_nonzero

NORMALISE = ("none", "nonzero")
OUTPUT = ("none", "clip", "sigmoid")


def declare(normalise: str, output: str) -> None:
    """Raise ValueError unless both are handlings that exist."""
    if normalise not in NORMALISE:
        raise ValueError(f"baseline.normalise must be one of {NORMALISE}, got {normalise}")
    if output not in OUTPUT:
        raise ValueError(f"baseline.output must be one of {OUTPUT}, got {output}")


def centre_view(
    voxels: Float[Tensor, "n views bins h w"],
    bins: int,
    normalise: str,
    positions: Sequence[Position] | None = None,
) -> Float[Tensor, "n bins h w"]:
    """Return the centre view, as it is or with non-zero entries standardised.

    `positions`: (row, col) of each view; None: `optics.layout`.  Raises ValueError when the grid
    has another number of bins.
    """
    if voxels.shape[2] != bins:
        raise ValueError(f"bins must be {bins} for this network, got {voxels.shape[2]}")
    view = voxels[:, centre(positions or layout(voxels.shape[1]))]
    return normalise_nonzero(view) if normalise == "nonzero" else view


def finish(
    frame: Float[Tensor, "n 1 h w"], output: str, training: bool
) -> Float[Tensor, "n 1 h w"]:
    """Return the frame after the declared handling; training sees unclipped frames."""
    if output == "sigmoid":
        return frame.sigmoid()
    return frame.clamp(0, 1) if output == "clip" and not training else frame
