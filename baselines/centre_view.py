"""What single-view networks share: the centre view in, a declared handling of input and output."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from src.models.layers import pad_centred_to_multiple
from src.models.network import (
    WINDOW_S,
    EventToVideoNetwork,
    check_state_sizes,
    check_voxel_shape,
)
from src.sim.optics import Position, check_positions, layout, most_central_view_index
from src.sim.voxel import normalise_nonzero


def find_centre_view(views: int, positions: Sequence[Position] | None) -> int:
    """Return the index of the most central of `views` views at `positions`, None: those of
    `layout`.  Raises ValueError for positions of another number.
    """
    positions = layout(views) if positions is None else positions
    check_positions(positions, views)
    return most_central_view_index(positions)


class CentreViewNetwork(EventToVideoNetwork):
    """The centre view's voxel grids to frames; a subclass has `predict_before_activation` and
    `state_sizes`.

    `normalise`: none, or nonzero, the non-zero entries standardised.  `output`: none, clip
    (training sees unclipped frames) or sigmoid.  Sides are padded to multiples of `side_multiple`.
    """

    side_multiple = 1
    uses_centre_view_only = True

    def __init__(self, bins: int, normalise: str, output: str):
        super().__init__()
        for name, value, allowed in (
            ("normalise", normalise, ("none", "nonzero")),
            ("output", output, ("none", "clip", "sigmoid")),
        ):
            if value not in allowed:
                raise ValueError(f"baseline.{name} must be one of {allowed}, got {value}")
        self.bins, self.normalise, self.output = bins, normalise, output

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        window_s: float | Tensor = WINDOW_S,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame and the state; `voxels` may be of any number type.

        Raises ValueError for another shape, number of bins or of positions, and for a state of
        other sizes.
        """
        check_voxel_shape(voxels)
        if voxels.shape[2] != self.bins:
            raise ValueError(f"bins must be {self.bins} for this network, got {voxels.shape[2]}")
        height, width = voxels.shape[-2:]
        dtype = next(self.parameters(), voxels).dtype
        view = voxels[:, find_centre_view(voxels.shape[1], positions)].to(dtype)
        view = normalise_nonzero(view) if self.normalise == "nonzero" else view
        grid, (top, left) = pad_centred_to_multiple(view, self.side_multiple)
        if state is not None:
            check_state_sizes(state, self.state_sizes(grid))
        frame, state = self.predict_before_activation(grid, state)
        return self.activate_output(frame[..., top : top + height, left : left + width]), state

    def predict_before_activation(
        self, grid: Float[Tensor, "n c h w"], state: Any
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame before `activate_output`, and the state."""
        raise NotImplementedError

    def state_sizes(self, grid: Float[Tensor, "n c h w"]) -> list[tuple[int, ...]]:
        """Return the sizes of the state's tensors, in order, that the padded `grid` leaves."""
        raise NotImplementedError

    def activate_output(self, frame: Float[Tensor, "n 1 h w"]) -> Float[Tensor, "n 1 h w"]:
        """Return the frame after the declared handling of the output."""
        if self.output == "sigmoid":
            return frame.sigmoid()
        return frame.clamp(0, 1) if self.output == "clip" and not self.training else frame
