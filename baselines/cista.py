"""CISTA-TC (Liu & Dragotti, ICASSP 2022): sparse codes of events, by unfolded shrinkage steps.

Events and the previous frame are measurements x of a code z at half resolution; each step takes
z to shrink(z + P(x - D z) + pull), the pull being towards the code of the window before, where both
codes agree.  A recurrent decoder turns the code into a frame.  All 3x3 with reflected borders.
"""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.centre_view import CentreViewNetwork
from src.models.layers import ConvLSTM

Code = Float[Tensor, "n c h w"]


class CISTA(CentreViewNetwork):
    """The centre view's voxel grids to frames; 1,260,867 parameters.

    `channels`: of each of the two stems (published: 32); the code has four times as many.
    `steps`: unfolded shrinkage steps (published: 5, all with the same weights).  As published:
    normalise nonzero, output sigmoid.
    """

    side_multiple = 2

    def __init__(
        self,
        bins: int = 5,
        channels: int = 32,
        steps: int = 5,
        normalise: str = "nonzero",
        output: str = "sigmoid",
    ):
        super().__init__(bins, normalise, output)
        both, code = 2 * channels, 4 * channels
        self.events, self.previous = _conv(bins, channels), _conv(1, channels)
        self.mix = _conv(both, both, stride=2)
        self.encode = _conv(both, code)
        self.steps = nn.ModuleList(ISTAStep(both, code) for _ in range(steps))
        self.agree_before, self.agree_now = _conv(code, 1), _conv(code, 1)
        self.pulls = nn.ParameterList(1e-3 * torch.rand(1, code, 1, 1) for _ in range(steps))
        self.decoder = _conv(code, both)
        self.cell = ConvLSTM(both, padding_mode="reflect")
        self.up = _conv(both, both)
        self.pred = _conv(both, 1)

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, Any]:
        """Return the frame and (code, state of the decoder, frame before cropping)."""
        code, memory, previous = state or (None, None, torch.zeros_like(grid[:, :1]))
        x = self.mix(torch.cat([self.events(grid), self.previous(previous)], 1))
        z = self._unfold(x, code)
        hidden, memory = self.cell(self.decoder(z).relu(), memory)
        upsampled = functional.interpolate(hidden, scale_factor=2, mode="bilinear")
        frame = self.pred(self.up(upsampled))
        return frame, (z, memory, self.activate_output(frame).detach())

    def state_sizes(self, grid: Tensor) -> list[tuple[int, ...]]:
        n, _, height, width = grid.shape
        code, hidden = self.encode.out_channels, self.decoder.out_channels
        coarse = [(n, channels, height // 2, width // 2) for channels in (code, hidden, hidden)]
        return [*coarse, (n, 1, height, width)]

    def _unfold(self, x: Tensor, before: Tensor | None) -> Tensor:
        z = self.encode(x)
        before = torch.zeros_like(z) if before is None else before
        agreed = self.agree_before(before)
        for step, pull in zip(self.steps, self.pulls, strict=True):
            agreement = (agreed * self.agree_now(z)).sigmoid()
            z = step(x, z, agreement * (before - z) * pull)
        return z


class ISTAStep(nn.Module):
    """One step of iterative shrinkage with learned synthesis D, analysis P and thresholds."""

    def __init__(self, features: int, code: int):
        super().__init__()
        self.synthesis, self.analysis = _conv(code, features), _conv(features, code)
        self.threshold = nn.Parameter(1e-3 * torch.rand(1, code, 1, 1))

    def forward(self, x: Float[Tensor, "n f h w"], z: Code, pull: Code) -> Code:
        z = z + self.analysis(x - self.synthesis(z)) + pull
        return (z - self.threshold).relu() - (-z - self.threshold).relu()


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, stride, padding=1, padding_mode="reflect")
