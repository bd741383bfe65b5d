"""FireNet and FireNet+ (Scheerlinck et al., WACV 2020; Stoffregen et al., ECCV 2020): one graph.

Full resolution, 16 channels, all 3x3: head -> ConvGRU -> residual block -> ConvGRU -> residual
block -> one channel.  37,777 parameters.
"""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn

from baselines.single_view import centre_view, declare, finish
from src.models.layers import ConvGRU, ResidualBlock
from src.sim.optics import Position


class FireNet(nn.Module):
    """The centre view's voxel grids to frames.

    `normalise`: nonzero (FireNet) or none (FireNet+).  `output`: none (FireNet) or clip (FireNet+).
    """

    views = None

    def __init__(
        self, bins: int = 5, channels: int = 16, normalise: str = "none", output: str = "clip"
    ):
        super().__init__()
        declare(normalise, output)
        self.bins, self.normalise, self.output = bins, normalise, output
        self.head = nn.Conv2d(bins, channels, 3, padding=1)
        self.cells = nn.ModuleList(ConvGRU(channels) for _ in range(2))
        self.resblocks = nn.ModuleList(ResidualBlock(channels) for _ in range(2))
        self.pred = nn.Conv2d(channels, 1, 1)

    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Any = None,
        *,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Any]:
        """Return the frame and the two hidden maps."""
        x = self.head(self.see(voxels, positions)).relu()
        after = []
        for cell, block, before in zip(
            self.cells, self.resblocks, state or (None, None), strict=True
        ):
            x, new = cell(x, before)
            x = block(x)
            after.append(new)
        return finish(self.pred(x), self.output, self.training), tuple(after)

    def see(
        self, voxels: Float[Tensor, "n views bins h w"], positions: Sequence[Position] | None
    ) -> Float[Tensor, "n c h w"]:
        """Return what the first convolution is given: the centre view."""
        return centre_view(voxels, self.bins, self.normalise, positions)
