"""E2VID+ (Stoffregen et al., ECCV 2020): E2VID without a final activation, on the centre view."""

from typing import Any

from torch import Tensor

from baselines.centre_view import CentreViewNetwork
from src.models.e2vid import E2VID, SCALES


class E2VIDPlus(CentreViewNetwork):
    """The centre view's voxel grids to frames; 10,710,401 parameters.

    As published: normalise none, output clip.  E2VID itself is normalise nonzero, output sigmoid.
    """

    side_multiple = 2**SCALES

    def __init__(
        self, bins: int = 5, base_channels: int = 32, normalise: str = "none", output: str = "clip"
    ):
        super().__init__(bins, normalise, output)
        self.net = E2VID(1, bins, base_channels, final_activation="none")

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, Any]:
        return self.net(grid[:, None], state)

    def state_sizes(self, grid: Tensor) -> list[tuple[int, ...]]:
        return self.net.state_sizes(grid)
