"""E2VID+ (Stoffregen et al., ECCV 2020): E2VID without a final activation, on the centre view."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from baselines.single_view import centre_view, declare, finish
from src.models.e2vid import E2VID
from src.sim.optics import Position


class E2VIDPlus(nn.Module):
    """The centre view's voxel grids to frames; 10,710,401 parameters.

    As published: normalise none, output clip.  E2VID itself is normalise nonzero, output sigmoid.
    """

    views = None

    def __init__(
        self,
        bins: int = 5,
        base_channels: int = 32,
        normalise: str = "none",
        output: str = "clip",
    ):
        super().__init__()
        declare(normalise, output)
        self.bins, self.normalise, self.output = bins, normalise, output
        self.net = E2VID(1, bins, base_channels, final_activation="none")

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame and the state of E2VID."""
        view = centre_view(voxels, self.bins, self.normalise, positions)
        frame, state = self.net(view[:, None], state)
        return finish(frame, self.output, self.training), state
