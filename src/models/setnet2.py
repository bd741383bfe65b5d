"""SetNet, second generation: pictures are remembered at a half, a quarter and an eighth.

What goes in and what is kept is the first's (setnet.py): views as a set, leaky sums, time that
passes in seconds and only where events come.  New are a memory at half resolution, where a picture
is fine enough to be kept and not only drawn, and units of one gate beside a candidate, in one
convolution, which are cheaper on a CPU than a GRU's (docs/decisions/0017-a-finer-memory.md).

half: stem, kept unit -> quarter: unit -> eighth: unit, residual block -> up, up -> 2 x 2 pixels.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.layers import ResidualBlock
from src.models.setnet import MEMORIES_S, RATE, SetNet, ViewKernels, grown

SIZES = {  # multiply-accumulates at 176 x 176 with nine views: 0.4, 1.1 and 3.0 G
    "small": {"half": 16},
    "medium": {"half": 28},
    "large": {"half": 48},
}


class SetNet2(SetNet):
    """Voxel grids of 1 to 25 views to frames in [0, 1], window by window.

    `half`: channels at half resolution, doubled at a quarter and again at an eighth.
    """

    sizes = SIZES

    def __init__(self, bins: int = 5, half: int = 16):
        nn.Module.__init__(self)
        self.arguments = {"bins": bins, "half": half}
        self.bins, self.frozen = bins, None
        memories, quarter, eighth = len(MEMORIES_S), 2 * half, 4 * half
        self.voxel_stem = ViewKernels(bins, half, 5)
        self.sum_stem = ViewKernels(memories, half, 3)
        self.spread_stem = nn.Conv2d(memories, half, 3, padding=1, bias=False)
        self.cell2 = PacedUnit(half, reach=1)
        self.down4 = nn.Conv2d(half, quarter, 3, 2, padding=1)
        self.cell4 = PacedUnit(quarter)
        self.down8 = nn.Conv2d(quarter, eighth, 3, 2, padding=1)
        self.cell8 = PacedUnit(eighth)
        self.block8 = ResidualBlock(eighth)
        self.up4 = nn.Conv2d(eighth, quarter, 1)
        self.mix4 = nn.Conv2d(quarter, quarter, 3, padding=1)
        self.up2 = nn.Conv2d(quarter, half, 1)
        self.mix2 = nn.Conv2d(half, half, 3, padding=1)
        self.shuffle = nn.Conv2d(half, self.cell**2, 3, padding=1)
        self.skip = nn.Parameter(torch.full((memories,), 0.15))

    def hidden(self, height: int, width: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the hidden maps of a picture."""
        half = self.up2.out_channels
        return [(half * 2**k, height // 2 ** (k + 1), width // 2 ** (k + 1)) for k in range(3)]

    def after_stem(
        self, stem: Tensor, passed: Tensor, hidden2: Tensor, hidden4: Tensor, hidden8: Tensor
    ) -> tuple[Float[Tensor, "n 4 h2 w2"], Tensor, Tensor, Tensor]:
        """Return what is drawn and the new hidden maps, as SetNet's does."""
        stem, pace = stem.relu(), RATE * passed
        hidden2 = self.cell2(stem, hidden2, grown(pace, 4))
        after2 = hidden2.to(stem.dtype)
        hidden4 = self.cell4(self.down4(after2).relu(), hidden4, grown(pace, 2))
        after4 = hidden4.to(stem.dtype)
        hidden8 = self.cell8(self.down8(after4).relu(), hidden8, pace)
        x = self.block8(hidden8.to(stem.dtype))
        x = self.mix4((grown(self.up4(x), 2) + after4).relu()).relu()
        x = self.mix2((grown(self.up2(x), 2) + after2).relu()).relu()
        return self.shuffle(x).float(), hidden2, hidden4, hidden8


class PacedUnit(nn.Module):
    """A gate beside a candidate, of one convolution, in continuous time.

    Of the old state exp(-pace * relu(gate)) is left and the rest is the candidate's tanh: without
    pace, or with a gate below zero, nothing changes.  `reach`: pixels, odd, over which a place sees
    the state; 1: its own only, so that nothing wanders from place to place.
    """

    def __init__(self, channels: int, reach: int = 3):
        super().__init__()
        self.seen = nn.Conv2d(channels, 2 * channels, 3, padding=1)
        self.kept = nn.Conv2d(channels, 2 * channels, reach, padding=reach // 2, bias=False)
        with torch.no_grad():  # memories of one to twenty windows from the start
            self.seen.bias[:channels].copy_(torch.linspace(0.05, 0.7, channels))

    def forward(
        self,
        x: Float[Tensor, "n c h w"],
        state: Float[Tensor, "n c h w"],
        pace: Float[Tensor, "n 1 h w"],
    ) -> Float[Tensor, "n c h w"]:
        """Return the new state, float32; `pace` is the time passed, in windows at 120 a second."""
        both = (self.seen(x) + self.kept(state.to(x.dtype))).float()
        gate, candidate = both.chunk(2, 1)
        return torch.lerp(candidate.tanh(), state, torch.exp(-pace * gate.relu()))
