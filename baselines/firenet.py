"""FireNet and FireNet+ (Scheerlinck et al., WACV 2020; Stoffregen et al., ECCV 2020): one graph.

Full resolution, 16 channels, all 3x3: head -> ConvGRU -> residual block -> ConvGRU -> residual
block -> one channel.  37,777 parameters.
"""

from typing import Any

from torch import Tensor, nn

from baselines.centre_view import CentreViewNetwork
from src.models.layers import ConvGRU, ResidualBlock


class FireNet(CentreViewNetwork):
    """The centre view's voxel grids to frames.

    `normalise`: nonzero (FireNet) or none (FireNet+).  `output`: none (FireNet) or clip (FireNet+).
    """

    def __init__(
        self, bins: int = 5, channels: int = 16, normalise: str = "none", output: str = "clip"
    ):
        super().__init__(bins, normalise, output)
        self.head = nn.Conv2d(bins, channels, 3, padding=1)
        self.cells = nn.ModuleList(ConvGRU(channels) for _ in range(2))
        self.resblocks = nn.ModuleList(ResidualBlock(channels) for _ in range(2))
        self.pred = nn.Conv2d(channels, 1, 1)

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, Any]:
        x, after, states = self.head(grid).relu(), [], state or (None, None)
        for cell, block, before in zip(self.cells, self.resblocks, states, strict=True):
            x, new = cell(x, before)
            x = block(x)
            after.append(new)
        return self.pred(x), tuple(after)

    def state_sizes(self, grid: Tensor) -> list[tuple[int, ...]]:
        return [(len(grid), self.head.out_channels, *grid.shape[2:])] * len(self.cells)
