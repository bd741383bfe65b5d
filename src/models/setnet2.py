"""SetNet, second generation: pictures are remembered at a half, a quarter and an eighth.

What goes in and what is kept is the first's (setnet.py): views as a set, leaky sums, time that
passes in seconds.  New are a memory at half resolution, where a picture is fine enough to be kept
and not only drawn; units of a gate beside a candidate, cheaper on a CPU than GRUs
(docs/decisions/0017-a-finer-memory.md); and, so that areas are drawn and not only edges, time that
passes everywhere while anything moves, nothing drawn but what is learned, and a view of what lies
far around (docs/decisions/0018-areas-without-events.md).

half: stem, kept unit -> quarter: unit -> eighth: unit, residual block, surroundings at a sixteenth
and a thirty-second -> up, up -> 2 x 2 pixels.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models.layers import ResidualBlock
from src.models.setnet import RATE, SetNet, grown, over_time

SIZES = {  # multiply-accumulates at 176 x 176 with nine views: 0.5, 1.2 and 3.1 G
    "small": {"half": 16},
    "medium": {"half": 28},
    "large": {"half": 48},
}


class SetNet2(SetNet):
    """Voxel grids of 1 to 25 views to frames in [0, 1], window by window.

    `half`: channels at half resolution, doubled at a quarter and again at an eighth.
    """

    sizes = SIZES
    local, direct = False, 0

    def __init__(self, bins: int = 5, half: int = 16):
        super().__init__(bins, half, 2 * half)
        self.arguments = {"bins": bins, "half": half}
        self.cell2 = PacedUnit(half, reach=1)
        self.block8 = nn.Sequential(self.block8, Surroundings(4 * half))

    def unit(self, channels: int) -> nn.Module:
        """As SetNet's."""
        return PacedUnit(channels)

    def hidden(self, height: int, width: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the hidden maps of a picture."""
        finest = (self.arguments["half"], height // 2, width // 2)
        return [finest, *super().hidden(height, width)]

    def after_stem(
        self, stem: Tensor, passed: Tensor, hidden2: Tensor, hidden4: Tensor, hidden8: Tensor
    ) -> tuple[Float[Tensor, "n 4 h2 w2"], Tensor, Tensor, Tensor]:
        """Return what is drawn and the new hidden maps, as SetNet's does."""
        all2, hidden2 = self.cell2(stem.relu(), hidden2, grown(RATE * passed, 4))
        drawn, *coarser = self.below(all2.to(stem.dtype), passed, hidden4, hidden8)
        return drawn, hidden2, *coarser


class Surroundings(nn.Module):
    """Adds to a map what lies around each place: it is halved twice, and comes back.

    An area without events is known by its edges, which may be far.
    """

    def __init__(self, channels: int):
        super().__init__()
        self.down16 = nn.Conv2d(channels, channels, 3, 2, padding=1)
        self.down32 = nn.Conv2d(channels, channels, 3, 2, padding=1)
        self.block32 = ResidualBlock(channels)
        self.up16 = nn.Conv2d(channels, channels, 1)
        self.block16 = ResidualBlock(channels)
        self.up8 = nn.Conv2d(channels, channels, 1)

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return a map of the same shape."""
        x16 = self.down16(x).relu()
        x32 = self.block32(self.down32(x16).relu())
        x16 = self.block16(x16 + _stretched(self.up16(x32), x16))
        return x + _stretched(self.up8(x16), x)


class PacedUnit(nn.Module):
    """A gate beside a candidate in continuous time.

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
        x: Float[Tensor, "m c h w"],
        state: Float[Tensor, "n c h w"],
        pace: Float[Tensor, "m 1 h w"],
    ) -> tuple[Float[Tensor, "m c h w"], Float[Tensor, "n c h w"]]:
        """Return the state, float32, after every one of m = windows * n steps and after the last.

        `pace` is the time passed, in windows at 120 a second.
        """

        def step(state: Tensor, seen: Tensor, pace: Tensor) -> Tensor:
            both = (seen + self.kept(state.to(x.dtype))).float()
            gate, candidate = both.chunk(2, 1)
            return torch.lerp(candidate.tanh(), state, torch.exp(-pace * gate.relu()))

        return over_time(step, state, self.seen(x), pace)


def _stretched(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, like.shape[-2:], mode="bilinear")
