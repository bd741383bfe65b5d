"""PIE-Net and PIE-Net-Lite (Qu et al., package event-pienet 1.1.3): intensity by a mapping.

A recurrent U-Net takes the events of a window and the frame before, and gives mean m and variance v
of the relative change of intensity and a refined frame r.  With an offset k of these three, the
frame is (r + k) m - k and its variance (r + k)^2 v, which gates the skips of the next window.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from baselines.centre_view import CentreViewNetwork

Map = Float[Tensor, "n _c _h _w"]  # each of its own channels and size
Memory = tuple[Tensor, Tensor]  # hidden and cell map


class PIENetState(NamedTuple):
    """What goes from window to window; zeros start a sequence."""

    memories: tuple[Memory | None, ...]
    frame: Float[Tensor, "n 1 h w"]  # in [0, 1]
    variance: Float[Tensor, "n 1 h w"]
    begun: Float[Tensor, "n 1 1 1"]  # 1: there is a variance to gate with


class PIENet(CentreViewNetwork):
    """The centre view's voxel grids to frames; 171,121 parameters, Lite 78,537.

    `channels`, `pools`: of each scale, finest first (Lite: 12 base channels, (16, 24), (2, 2)).
    `refine`: a convolution behind each memory.  The checkpoint of PIE-Net has it, and the published
    1.59 G operations count it; event-pienet 1.1.3 runs without: 154,201 parameters, other frames.
    As published: normalise none, output clip.  The norms are over the whole picture: a part of it
    alone looks different.
    """

    def __init__(
        self,
        bins: int = 5,
        base_channels: int = 8,
        channels: Sequence[int] = (16, 24, 32),
        pools: Sequence[int] = (2, 2, 5),
        refine: bool = True,
        normalise: str = "none",
        output: str = "clip",
    ):
        super().__init__(bins, normalise, output)
        inputs = (base_channels, *channels[:-1])
        scales = list(zip(inputs, channels, pools, strict=True))
        self.events, self.previous = ConvNorm(bins, base_channels), ConvNorm(1, base_channels)
        self.encoders = nn.ModuleList(
            FiLMConvLSTM(finer, width, pool, 2 * base_channels, refine)
            for finer, width, pool in scales
        )
        self.decoders = nn.ModuleList(
            VarianceGatedDecoder(width, finer, pool) for finer, width, pool in reversed(scales)
        )
        self.pred = nn.Conv2d(base_channels, 3, 1)
        self.offset = ConvNorm(3, 1)

    def predict_before_activation(self, grid: Tensor, state: Any) -> tuple[Tensor, PIENetState]:
        if state is None:
            blank = torch.zeros_like(grid[:, :1])
            state = PIENetState((None,) * len(self.encoders), blank, blank, blank[..., :1, :1])
        events, before = self.events(grid), self.previous(state.frame)
        summary = torch.cat([events, before], 1).mean((2, 3), keepdim=True)
        x, skips, memories = events + before, [], []
        for encoder, memory in zip(self.encoders, state.memories, strict=True):
            x, skip, memory = encoder(x, memory, summary)
            skips.append(skip)
            memories.append(memory)
        for decoder in self.decoders:
            x = decoder(x, skips.pop(), state.variance, state.begun)
        frame, variance = self._map_to_intensity(self.pred(x))
        shown = frame.detach().relu().clamp(max=1)  # ONNX's exporter drops the second clamp(0, 1)
        carried = shown, variance.detach(), torch.ones_like(state.begun)
        return frame, PIENetState(tuple(memories), *carried)

    def state_sizes(self, grid: Tensor) -> list[tuple[int, ...]]:
        n, _, height, width = grid.shape
        sizes, side = [], [height, width]
        for encoder in self.encoders:
            assert isinstance(encoder, FiLMConvLSTM)
            sizes += [(n, encoder.width, *side)] * 2
            side = [length // min(encoder.pool, *side) for length in side]
        return [*sizes, *[(n, 1, height, width)] * 2, (n, 1, 1, 1)]

    def _map_to_intensity(self, maps: Float[Tensor, "n 3 h w"]) -> tuple[Tensor, Tensor]:
        """Return frame and variance of mean and variance of the change and the refined frame."""
        offset = self.offset(maps).relu()
        mean, variance, refined = maps.relu().split(1, 1)
        level = refined + offset
        return level * mean - offset, level.square() * variance


class FiLMConvLSTM(nn.Module):
    """A memory whose hidden map is scaled and shifted by the summary of events and frame."""

    def __init__(self, inputs: int, width: int, pool: int, summary_channels: int, refine: bool):
        super().__init__()
        self.width, self.pool = width, pool
        both = inputs + width
        self.widen, self.weigh = ConvNorm(both, 2 * both), SqueezeExcitation(2 * both)
        self.gates = nn.Sequential(
            nn.Conv2d(2 * both, 4 * width, 1), Float32GroupNorm(1, 4 * width)
        )
        self.hidden_norm, self.cell_norm = Float32GroupNorm(4, width), Float32GroupNorm(4, width)
        self.refine = ConvNorm(width, width) if refine else None
        self.modulate = nn.Conv2d(summary_channels, 2 * width, 1)

    def forward(
        self, x: Map, memory: Memory | None, summary: Float[Tensor, "n s 1 1"]
    ) -> tuple[Map, Map, Memory]:
        """Return the pooled map, the map and the new memory; None starts from zeros."""
        if memory is None:
            blank = x.new_zeros(len(x), self.width, *x.shape[2:])
            memory = blank, blank
        hidden, cell = memory
        gates = self.gates(self.weigh(self.widen(torch.cat([x, hidden], 1))))
        i, f, o, candidate = gates.chunk(4, 1)
        cell = self.cell_norm(f.sigmoid() * cell + i.sigmoid() * candidate.tanh())
        hidden = self.hidden_norm(o.sigmoid() * cell.tanh())
        seen = hidden if self.refine is None else hidden + self.refine(hidden)
        scale, shift = self.modulate(summary).chunk(2, 1)
        seen = seen * (1 + scale) + shift
        pool = min(self.pool, *seen.shape[-2:])  # less on a map that is smaller
        return functional.max_pool2d(seen, pool), seen, (hidden, cell)


class VarianceGatedDecoder(nn.Module):
    """Grows a map to the size of its skip, which the variance of the last frame gates."""

    def __init__(self, inputs: int, outputs: int, pool: int):
        super().__init__()
        self.pool, self.gate = pool, nn.Conv2d(1, inputs, 1)
        self.fuse = ConvNorm(2 * inputs, outputs)

    def forward(self, x: Map, skip: Map, variance: Tensor, begun: Tensor) -> Map:
        height, width = skip.shape[-2:]
        gate = self.gate(resize(variance, height, width)).sigmoid()
        skip = torch.where(begun > 0, gate, 1.0) * skip
        factor = min(self.pool, height, width)
        x = resize(x, factor * x.shape[2], factor * x.shape[3])
        rows, columns = height - x.shape[2], width - x.shape[3]  # that pooling has left over
        edges = (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2)
        return self.fuse(torch.cat([skip, functional.pad(x, edges)], 1))


class SqueezeExcitation(nn.Module):
    """Weighs channels by what their means say (Hu et al. 2018)."""

    def __init__(self, channels: int):
        super().__init__()
        self.squeeze = nn.Conv2d(channels, max(1, channels // 8), 1, bias=False)
        self.excite = nn.Conv2d(max(1, channels // 8), channels, 1, bias=False)

    def forward(self, x: Map) -> Map:
        return x * self.excite(self.squeeze(x.mean((2, 3), keepdim=True)).relu()).sigmoid()


class ConvNorm(nn.Module):
    """A 3x3 convolution, a norm over all channels and pixels, SiLU."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, 3, padding=1)
        self.norm = Float32GroupNorm(1, outputs)

    def forward(self, x: Map) -> Map:
        return functional.silu(self.norm(self.conv(x)))


class Float32GroupNorm(nn.GroupNorm):
    """A norm over groups of channels and all pixels, in float32 also where the rest is bf16."""

    def forward(self, input: Map) -> Map:
        weight, bias = self.weight.float(), self.bias.float()
        normal = functional.group_norm(input.float(), self.num_groups, weight, bias, self.eps)
        return normal.to(input.dtype)


def resize(x: Map, height: int, width: int) -> Map:
    """Return the map at another size, its corners kept."""
    return functional.interpolate(x, (height, width), mode="bilinear", align_corners=True)
