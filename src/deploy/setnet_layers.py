"""The layers of a SetNet behind its event kernels, each on a batch of tiles or on whole maps.

A tile comes with as many cells around it, its halo, as its convolutions take in, which then pad
nothing; a whole map is padded by them.  Maps are channels last and float32 on the outside and of
`dtype` in the convolutions.
"""

from collections.abc import Sequence
from copy import deepcopy

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.deploy.int8 import Int8Conv
from src.models.layers import EqualDCConv, PreActivationBlock, bias_of
from src.models.setnet import (
    CELL_BORDER,
    CELL_PX,
    REFERENCE_HZ,
    ContextPyramid,
    SetNet,
    TimeGatedMemory,
)
from src.sim.optics import Position

BLOCK_HALO = 2  # cells that the two convolutions of a PreActivationBlock take in on each side


class MemoryLayers(nn.Module):
    """From the map of the events and the mixtures of the leaky sums to the hidden map.

    `mixture_code`: (views, mixtures of a sum): of the sums only as many mixtures are convolved as
    their kernels have basis kernels.
    """

    VOXEL_HALO, MIXTURE_HALO = 1, 2

    def __init__(
        self,
        network: SetNet,
        positions: Sequence[Position],
        dtype: torch.dtype,
        is_whole: bool = False,
    ):
        super().__init__()
        code, basis = network.sum_kernels.factors(torch.tensor(positions).float())
        kernels = [basis.transpose(0, 1).flatten(1, 2), network.spread_conv.weight]
        assert isinstance(network.memory, TimeGatedMemory)
        self.memory = SplitTimeGatedMemory(network.memory, int(is_whole)).to(dtype)
        self.mixture_code, self.kernel = code.numpy(), torch.cat(kernels, 1).to(dtype)
        self.dtype, self.padding = dtype, int(is_whole)

    def forward(
        self,
        voxel_map: Float[Tensor, "b h1 w1 c"],
        mixtures: Float[Tensor, "b h2 w2 m"],
        elapsed_s: Float[Tensor, "b h1 w1 1"],
        hidden: Float[Tensor, "b h w c"],
    ) -> Float[Tensor, "b h w c"]:
        """Return the hidden map after the window.  `elapsed_s`: 0 in cells that stand still and
        outside the frame."""
        voxel_map, mixtures = (channels_first(x.to(self.dtype)) for x in (voxel_map, mixtures))
        stem = voxel_map + functional.conv2d(mixtures, self.kernel, None, 1, self.padding)
        is_active = channels_first((elapsed_s > 0).to(self.dtype))
        inner = elapsed_s if self.padding else elapsed_s[:, 1:-1, 1:-1]
        elapsed = channels_first(REFERENCE_HZ * inner)
        return self.memory(stem.relu() * is_active, hidden, elapsed)


class SplitTimeGatedMemory(nn.Module):
    """A TimeGatedMemory for one window: gate and candidate come from convolutions of their own, as
    splitting a map in two costs as much as a convolution, and the state stays channels last.
    """

    def __init__(self, memory: TimeGatedMemory, padding: int):
        super().__init__()
        self.input_features = deepcopy(memory.input_features)
        if isinstance(self.input_features, nn.Conv2d):
            self.input_features.padding = (padding, padding)
        self.input_gates = nn.ParameterList(memory.input_gates.weight.chunk(2))
        self.bias = nn.ParameterList(bias_of(memory.input_gates).chunk(2))
        self.state_gates = nn.ParameterList(memory.state_gates.weight.chunk(2))
        self.padding = padding if len(memory.input_gates.weight[0, 0]) > 1 else 0

    def forward(
        self, x: Float[Tensor, "b c h1 w1"], state: Float[Tensor, "b h w c"], elapsed: Tensor
    ) -> Float[Tensor, "b h w c"]:
        """Return the state after the window; exactly `state` where `elapsed` is 0."""
        before = channels_first(state.to(x.dtype))
        features = self.input_features(x)
        gate, candidate = (
            functional.conv2d(features, of_input, bias, padding=self.padding)
            + functional.conv2d(before, of_state)
            for of_input, bias, of_state in zip(
                self.input_gates, self.bias, self.state_gates, strict=True
            )
        )
        keep = torch.exp(-elapsed * gate.relu().float())
        new = keep * channels_first(state) + (1 - keep) * candidate.tanh().float()
        return channels_last(new)


class WholeContext(nn.Module):
    """An update of the context on whole maps: ContextPyramid and its moving average."""

    def __init__(self, network: SetNet, dtype: torch.dtype):
        super().__init__()
        self.pyramid, self.dtype = deepcopy(network.context).to(dtype), dtype

    def forward(
        self,
        hidden: Float[Tensor, "1 h2 w2 c"],
        context: Float[Tensor, "1 h4 w4 c"],
        recency: Float[Tensor, "1 h4 w4 1"],
        is_updated: Float[Tensor, "1 h4 w4 1"],
        *held: Float[Tensor, "1 _h _w _c"],
    ) -> tuple[Tensor, ...]:
        """Return the context and the held maps after the update."""
        features = channels_first(hidden.to(self.dtype))
        mask = channels_first(is_updated)
        cells = functional.interpolate(mask, scale_factor=2, mode="nearest")
        new, scales = self.pyramid(features, tuple(map(channels_first, held)), cells > 0)
        before = channels_first(context)
        average = self.pyramid.moving_average(before, new.float(), channels_first(recency))
        context = torch.where(mask > 0, average, before)
        return channels_last(context), *map(channels_last, scales)


class ScaleLayers(nn.Module):
    """One scale of a ContextPyramid on tiles: from the finer map, with a halo of 5 of its cells
    behind and 4 before."""

    def __init__(self, pyramid: ContextPyramid, scale: int, dtype: torch.dtype):
        super().__init__()
        self.down = deepcopy(pyramid.downs[scale]).to(dtype)
        self.down.padding = (0, 0)
        self.block, self.dtype = TileBlock(pyramid.down_blocks[scale]).to(dtype), dtype

    def forward(
        self, x: Float[Tensor, "b s s c"], is_inside: Float[Tensor, "b t t 1"]
    ) -> Float[Tensor, "b u u d"]:
        """Return the map of the scale; `is_inside`: 1 in cells of the frame, with a halo of 2."""
        inside = channels_first(is_inside.to(self.dtype))
        new = self.block(self.down(channels_first(x.to(self.dtype))), inside)
        return channels_last(new).float()


class FusionLayers(nn.Module):
    """A scale of a ContextPyramid and the next coarser one, added on tiles with a halo of `halo`;
    behind the finest the update of the context."""

    def __init__(self, pyramid: ContextPyramid, scale: int, dtype: torch.dtype):
        super().__init__()
        block = pyramid.fusion_blocks[scale]
        is_block = isinstance(block, PreActivationBlock)
        self.halo = BLOCK_HALO if is_block else 0
        self.block = TileBlock(block).to(dtype) if is_block else None
        self.up, self.dtype = deepcopy(pyramid.ups[scale + 1]).to(dtype), dtype

    def forward(
        self,
        finer: Float[Tensor, "b t t c"],
        coarser: Float[Tensor, "b t t d"],
        is_inside: Float[Tensor, "b t t 1"],
    ) -> Float[Tensor, "b u u c"]:
        """Return the sum; `coarser`: after its ReLU, interpolated to the cells of `finer`."""
        return channels_last(self.fuse(finer, coarser, is_inside)).float()

    def fuse(self, finer: Tensor, coarser: Tensor, is_inside: Tensor) -> Tensor:
        finer, coarser, inside = (
            channels_first(part.to(self.dtype)) for part in (finer, coarser, is_inside)
        )
        new = finer + self.up(coarser)
        return new if self.block is None else self.block(new, inside)


class ContextLayers(FusionLayers):
    """The FusionLayers of the finest scale, and the update of the context from their sum."""

    def __init__(self, pyramid: ContextPyramid, dtype: torch.dtype):
        super().__init__(pyramid, 0, dtype)
        self.last, self.rate = deepcopy(pyramid.ups[0]).to(dtype), pyramid.log_rate.float().exp()

    def forward(  # type: ignore[override]
        self,
        finer: Float[Tensor, "b t t c"],
        coarser: Float[Tensor, "b t t d"],
        is_inside: Float[Tensor, "b t t 1"],
        context: Float[Tensor, "b u u o"],
        recency: Float[Tensor, "b u u 1"],
    ) -> Float[Tensor, "b u u o"]:
        """Return the context after the update."""
        new = self.last(self.fuse(finer, coarser, is_inside).relu()).float()
        keep = channels_first(recency) ** self.rate
        return channels_last(torch.lerp(new, channels_first(context), keep))


class TileBlock(nn.Module):
    """A PreActivationBlock on tiles: what is outside the frame is zero before each convolution."""

    def __init__(self, block: PreActivationBlock):
        super().__init__()
        self.conv1, self.conv2 = deepcopy(block.conv1), deepcopy(block.conv2)
        self.conv1.padding = self.conv2.padding = (0, 0)

    def forward(
        self, x: Float[Tensor, "b c t t"], inside: Float[Tensor, "b 1 t t"]
    ) -> Float[Tensor, "b c u u"]:
        y = self.conv1(x.relu() * inside)
        y = self.conv2(y.relu() * inside[..., 1:-1, 1:-1])
        return x[..., BLOCK_HALO:-BLOCK_HALO, BLOCK_HALO:-BLOCK_HALO] + y


class DecoderLayers(nn.Module):
    """From hidden map and context to the pixels of every 2 x 2 cells; `decoder_conv`: of `network`,
    in bytes or not."""

    HALO = CELL_BORDER

    def __init__(self, network: SetNet, dtype: torch.dtype, is_whole: bool = False):
        super().__init__()
        assert isinstance(network.pixel_conv, EqualDCConv)
        self.pixel_conv = TwoByTwoCellConv(network.pixel_conv, CELL_PX).to(dtype)
        conv = deepcopy(network.decoder_conv).to(dtype)
        if not is_whole and isinstance(conv, Int8Conv):
            conv.padding = 0
        elif not is_whole:
            assert isinstance(conv, nn.Conv2d)
            conv.padding, conv.padding_mode = (0, 0), "zeros"
        self.decoder_conv, self.dtype = conv, dtype

    def forward(self, x: Float[Tensor, "b h w c"]) -> Float[Tensor, "b hq wq pixels"]:
        """Return the pixels; `x`: the sum of both, after its ReLU."""
        x = self.decoder_conv(channels_first(x.to(self.dtype))).relu()
        return channels_last(self.pixel_conv(x).float().sigmoid())


class WholeDecoder(DecoderLayers):
    """DecoderLayers on whole maps."""

    def __init__(self, network: SetNet, dtype: torch.dtype):
        super().__init__(network, dtype, True)

    def forward(  # type: ignore[override]
        self, hidden: Float[Tensor, "1 h w c"], context: Float[Tensor, "1 hq wq c"]
    ) -> Float[Tensor, "1 hq wq pixels"]:
        """Return the pixels."""
        far, near = (channels_first(part.to(self.dtype)) for part in (context, hidden))
        x = functional.interpolate(far, scale_factor=2, mode="nearest") + near
        return super().forward(channels_last(x.relu()))


class TwoByTwoCellConv(nn.Module):
    """An EqualDCConv that gives the pixels of 2 x 2 cells of `side` pixels at once, row by row: as
    few outputs as those of one cell leave most of a processor's registers empty.
    """

    def __init__(self, conv: EqualDCConv, side: int):
        super().__init__()
        kernels, bias = (part.detach() for part in conv.equalised())
        width = 2 * side  # of 2 x 2 cells, in pixels
        _, channels, size, _ = kernels.shape
        weight = kernels.new_zeros(width, width, channels, size + 1, size + 1)
        for row, column in np.ndindex(width, width):
            (down, a), (right, b) = divmod(row, side), divmod(column, side)
            kernel = kernels[side * a + b]
            weight[row, column, :, down : down + size, right : right + size] = kernel
        self.weight = nn.Parameter(weight.flatten(0, 1))
        self.bias = nn.Parameter(bias[0].repeat(width**2))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n pixels _h _w"]:
        """Return the maps of all pixels of 2 x 2 cells."""
        return functional.conv2d(x, self.weight, self.bias, 2)


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    """Return a view of `x`."""
    return x.permute(0, 3, 1, 2)


def channels_last(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w c"]:
    """Return a view of `x`."""
    return x.permute(0, 2, 3, 1)
