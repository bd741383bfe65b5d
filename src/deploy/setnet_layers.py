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
from src.models.layers import EqualDCConv, require_bias
from src.models.setnet import CELL_BORDER, CELL_PX, REFERENCE_HZ, SetNet
from src.models.time_gated_memory import TimeGatedMemory
from src.sim.optics import Position


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
        return channels_last(self.advance(voxel_map, mixtures, elapsed_s, hidden))

    def advance(
        self, voxel_map: Tensor, mixtures: Tensor, elapsed_s: Tensor, hidden: Tensor
    ) -> Float[Tensor, "b c h w"]:
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
        self.bias = nn.ParameterList(require_bias(memory.input_gates).chunk(2))
        self.state_gates = nn.ParameterList(memory.state_gates.weight.chunk(2))
        self.padding = padding if len(memory.input_gates.weight[0, 0]) > 1 else 0

    def forward(
        self, x: Float[Tensor, "b c h1 w1"], state: Float[Tensor, "b h w c"], elapsed: Tensor
    ) -> Float[Tensor, "b c h w"]:
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
        return keep * channels_first(state) + (1 - keep) * candidate.tanh().float()


class DecoderLayers(nn.Module):
    """From hidden map and context to the pixels of every 2 x 2 cells; `decoder_conv`: of `network`,
    in bytes or not."""

    HALO = CELL_BORDER

    def __init__(self, network: SetNet, dtype: torch.dtype, is_whole: bool = False):
        super().__init__()
        assert isinstance(network.pixel_conv, EqualDCConv)
        self.pixel_conv = TwoByTwoCellConv(network.pixel_conv).to(dtype)
        conv = deepcopy(network.decoder_conv) if is_whole else unpadded(network.decoder_conv)
        self.decoder_conv, self.dtype = conv.to(dtype), dtype

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
        return self.draw(channels_first(hidden), context)

    def draw(self, hidden: Tensor, context: Tensor) -> Tensor:
        far, near = channels_first(context.to(self.dtype)), hidden.to(self.dtype)
        x = functional.interpolate(far, scale_factor=2, mode="nearest") + near
        return super().forward(channels_last(x.relu()))


class WholeWindow(nn.Module):
    """MemoryLayers and WholeDecoder on whole maps."""

    def __init__(self, network: SetNet, positions: Sequence[Position], dtype: torch.dtype):
        super().__init__()
        self.memory = MemoryLayers(network, positions, dtype, True)
        self.decoder = WholeDecoder(network, dtype)

    def forward(
        self,
        voxel_map: Tensor,
        mixtures: Tensor,
        elapsed_s: Tensor,
        hidden: Tensor,
        context: Tensor,
    ) -> tuple[Float[Tensor, "1 h w c"], Float[Tensor, "1 hq wq pixels"]]:
        """Return the hidden map after the window and the pixels."""
        new = self.memory.advance(voxel_map, mixtures, elapsed_s, hidden)
        return channels_last(new), self.decoder.draw(new, context)


class TwoByTwoCellConv(nn.Module):
    """An EqualDCConv that gives the pixels of 2 x 2 cells of CELL_PX pixels at once, row by row: as
    few outputs as those of one cell leave most of a processor's registers empty.
    """

    def __init__(self, conv: EqualDCConv):
        super().__init__()
        kernels, bias = (part.detach() for part in conv.equalised())
        width = 2 * CELL_PX  # of 2 x 2 cells, in pixels
        _, channels, size, _ = kernels.shape
        weight = kernels.new_zeros(width, width, channels, size + 1, size + 1)
        for row, column in np.ndindex(width, width):
            (down, a), (right, b) = divmod(row, CELL_PX), divmod(column, CELL_PX)
            kernel = kernels[CELL_PX * a + b]
            weight[row, column, :, down : down + size, right : right + size] = kernel
        self.weight = nn.Parameter(weight.flatten(0, 1))
        self.bias = nn.Parameter(bias[0].repeat(width**2))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n pixels _h _w"]:
        """Return the maps of all pixels of 2 x 2 cells."""
        return functional.conv2d(x, self.weight, self.bias, 2)


def unpadded(conv: nn.Module) -> nn.Module:
    """Return a copy of a convolution, in bytes or not, that pads nothing."""
    assert isinstance(conv, nn.Conv2d | Int8Conv)
    copied = deepcopy(conv)
    copied.padding = (0, 0)
    if isinstance(copied, nn.Conv2d):
        copied.padding_mode = "zeros"
    return copied


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    return x.permute(0, 3, 1, 2)


def channels_last(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w c"]:
    return x.permute(0, 2, 3, 1)
