"""ET-Net (Weng et al., ICCV 2021): E2VID with transformers over three scales in its middle.

The hidden maps at 1/2, 1/4 and 1/8 become equally many tokens; each scale attends to itself, then
to the coarser one; the mean of all of them replaces the residual blocks.  Attention is fused, so
that its maps are never stored.
"""

from itertools import chain, pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.e2vid_plus import E2VIDPlus
from src.models.e2vid import SCALES

HEADS, DROPOUT = 8, 0.1
Tokens = Float[Tensor, "n tokens c"]


class ETNet(E2VIDPlus):
    """The centre view's voxel grids to frames; 22,175,361 parameters.

    As published: normalise none, output sigmoid.
    """

    def __init__(
        self,
        bins: int = 5,
        base_channels: int = 32,
        normalise: str = "none",
        output: str = "sigmoid",
    ):
        super().__init__(bins, base_channels, normalise, output)
        self.net.resblocks = nn.Sequential()
        self.pyramid = TokenPyramidAggregation(
            [base_channels * 2**scale for scale in range(SCALES, 0, -1)]
        )

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, Any]:
        head, skips, after = self.net.encode(self.net.first_layer(grid), state)
        return self.net.decode_logits(self.pyramid(skips[::-1]), head, skips), after


class TokenPyramidAggregation(nn.Module):
    """Tokens of each scale attend to themselves and to the next coarser scale.

    `widths`: channels of the maps, coarsest first; the tokens have as many as the coarsest.
    """

    def __init__(self, widths: list[int]):
        super().__init__()
        width = widths[0]
        self.split = nn.ModuleList(
            nn.Conv2d(inputs, width, 2**scale, 2**scale)
            for scale, inputs in enumerate(widths[1:], 1)
        )
        self.own = nn.ModuleList(
            nn.Sequential(*(TransformerLayer(width) for _ in range(3))) for _ in widths
        )
        self.across = nn.ModuleList(
            nn.ModuleList(TransformerLayer(width, with_cross_attention=True) for _ in range(2))
            for _ in widths
        )
        for parameter in chain(self.own.parameters(), self.across.parameters()):
            if parameter.dim() > 1:
                nn.init.xavier_uniform_(parameter)

    def forward(self, maps: list[Tensor]) -> Float[Tensor, "n c h w"]:
        """Return the map at the coarsest resolution; `maps` are finest last."""
        coarse = [maps[0]] + [s(x) for s, x in zip(self.split, maps[1:], strict=True)]
        tokens = [x.flatten(2).transpose(1, 2) for x in coarse]
        places = sinusoidal_position_encoding(tokens[0].shape[1], tokens[0].shape[2]).to(tokens[0])
        seen = [layers(x + places) for layers, x in zip(self.own, tokens, strict=True)]
        compared = []
        for layers, (memory, x) in zip(self.across, pairwise([seen[0], *seen]), strict=True):
            for layer in layers:  # type: ignore[attr-defined]
                x = layer(x, memory)
            compared.append(x)
        return torch.stack(seen + compared).mean(0).transpose(1, 2).view_as(maps[0])


class TransformerLayer(nn.Module):
    """Self-attention, attention to a memory if `with_cross_attention`, and a two-layer perceptron,
    each normalised before and added.
    """

    def __init__(self, width: int, with_cross_attention: bool = False):
        super().__init__()
        self.norm, self.attention = nn.LayerNorm(width), MultiHeadAttention(width)
        if with_cross_attention:
            self.asker_norm, self.memory_norm = nn.LayerNorm(width), nn.LayerNorm(width)
            self.cross = MultiHeadAttention(width)
        self.mlp = ResidualMLP(width)

    def forward(self, x: Tokens, memory: Tokens | None = None) -> Tokens:
        normal = self.norm(x)
        x = x + self.attention(normal, normal)
        if memory is not None:
            x = x + self.cross(self.asker_norm(x), self.memory_norm(memory))
        return self.mlp(x)


class MultiHeadAttention(nn.Module):
    """Attention with eight heads (Vaswani et al. 2017), fused."""

    def __init__(self, width: int):
        super().__init__()
        self.project, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)

    def forward(self, x: Tokens, memory: Tokens) -> Tokens:
        """Return what the tokens `x` find in `memory`; dropped out in training."""
        weights, biases = self.project.weight.chunk(3), self.project.bias.chunk(3)
        q, k, v = (
            functional.linear(source, weight, bias).unflatten(2, (HEADS, -1)).transpose(1, 2)
            for source, weight, bias in zip((x, memory, memory), weights, biases, strict=True)
        )
        rate = DROPOUT if self.training else 0.0
        attended = functional.scaled_dot_product_attention(q, k, v, dropout_p=rate)
        attended = self.out(attended.transpose(1, 2).flatten(2))
        return functional.dropout(attended, DROPOUT, self.training)


class ResidualMLP(nn.Module):
    """Normalise, four times as wide, ReLU, back, add."""

    def __init__(self, width: int):
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.wide, self.back = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(self, x: Tokens) -> Tokens:
        hidden = functional.dropout(self.wide(self.norm(x)).relu(), DROPOUT, self.training)
        return x + functional.dropout(self.back(hidden), DROPOUT, self.training)


def sinusoidal_position_encoding(tokens: int, width: int) -> Float[Tensor, "tokens width"]:
    """Return the position code of tokens 0 .. tokens - 1 (Vaswani et al. 2017, section 3.5)."""
    pitch = 10_000.0 ** (-torch.arange(0, width, 2, dtype=torch.float64) / width)
    angles = torch.arange(tokens, dtype=torch.float64)[:, None] * pitch
    return torch.stack([angles.sin(), angles.cos()], 2).flatten(1).float()
