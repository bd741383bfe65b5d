"""SetNet, second generation: fewer and fatter layers, all of them at a quarter and an eighth.

What goes in and what is kept is the first's (setnet.py): views as a set, leaky sums, time that
passes in seconds and only where events come.  New is where the work is done: layers of few channels
at a half of the resolution are what a CPU is slowest at for their arithmetic (decisions 10 and 11),
so that the full resolution goes in through patches of 7 x 7 pixels and comes out as the sixteen
pixels of a cell.

quarter: patches, unit -> eighth: unit, residual block -> quarter: mix -> 4 x 4 pixels a cell.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.layers import ResidualBlock
from src.models.setnet import MEMORIES_S, RATE, SetNet, ViewKernels, grown

SIZES = {  # multiply-accumulates at 176 x 176 with nine views: 0.4, 1.1 and 3.9 G
    "small": {"quarter": 32, "eighth": 64},
    "medium": {"quarter": 64, "eighth": 128},
    "large": {"quarter": 128, "eighth": 256},
}


class SetNet2(SetNet):
    """Voxel grids of 1 to 25 views to frames in [0, 1], window by window.

    `quarter`, `eighth`: channels at these resolutions.
    """

    cell = 4
    sizes = SIZES

    def __init__(self, bins: int = 5, quarter: int = 32, eighth: int = 64):
        nn.Module.__init__(self)
        self.arguments = {"bins": bins, "quarter": quarter, "eighth": eighth}
        self.bins, self.frozen = bins, None
        memories = len(MEMORIES_S)
        self.voxel_stem = ViewKernels(bins, quarter, 7)
        self.sum_stem = ViewKernels(memories, quarter, 3)
        self.spread_stem = nn.Conv2d(memories, quarter, 3, padding=1, bias=False)
        self.cell4 = PacedUnit(quarter)
        self.down8 = nn.Conv2d(quarter, eighth, 3, 2, padding=1)
        self.cell8 = PacedUnit(eighth)
        self.block8 = ResidualBlock(eighth)
        self.up4 = nn.Conv2d(eighth, quarter, 1)
        self.mix4 = nn.Conv2d(quarter, quarter, 3, padding=1)
        self.draw4 = nn.Conv2d(quarter, self.cell**2, 3, padding=1)
        self.skip = nn.Parameter(torch.full((memories,), 0.15))

    def after_stem(
        self, stem: Tensor, passed: Tensor, hidden4: Tensor, hidden8: Tensor
    ) -> tuple[Float[Tensor, "n 16 h4 w4"], Tensor, Tensor]:
        """Return what is drawn and the new hidden maps, as SetNet's does."""
        stem, pace = stem.relu(), RATE * passed
        hidden4 = self.cell4(stem, hidden4, grown(pace, 2))
        after4 = hidden4.to(stem.dtype)
        hidden8 = self.cell8(self.down8(after4).relu(), hidden8, pace)
        x = self.block8(hidden8.to(stem.dtype))
        x = self.mix4((grown(self.up4(x), 2) + after4).relu()).relu()
        return self.draw4(x).float(), hidden4, hidden8


class PacedUnit(nn.Module):
    """A gate beside a candidate, of one convolution, in continuous time.

    Of the old state exp(-pace * relu(gate)) is left and the rest is the candidate's tanh: without
    pace, or with a gate below zero, nothing changes.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 2 * channels, 3, padding=1)
        with torch.no_grad():  # memories of one to twenty windows from the start
            self.gates.bias[:channels].copy_(torch.linspace(0.05, 0.7, channels))

    def forward(
        self,
        x: Float[Tensor, "n c h w"],
        state: Float[Tensor, "n c h w"],
        pace: Float[Tensor, "n 1 h w"],
    ) -> Float[Tensor, "n c h w"]:
        """Return the new state, float32; `pace` is the time passed, in windows at 120 a second."""
        both = self.gates(torch.cat([x, state.to(x.dtype)], 1)).float()
        gate, candidate = both.chunk(2, 1)
        return torch.lerp(candidate.tanh(), state, torch.exp(-pace * gate.relu()))
