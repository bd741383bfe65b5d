"""The layers of a network behind its first one, for one clip: maps in, pixels and state out.

Maps come channels last, as events are added to them; `kernel`, `bias`, `stride` and `views` say
what the first layer is.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.utils import _pytree as pytree

from src.deploy.cost import torch_threads
from src.models.e2vid import E2VID
from src.models.layers import EqualDCConv, require_bias
from src.models.setnet import CELL_PX, SetNet, TimeGatedMemory, smooth_context
from src.sim.optics import Position


class E2VIDRemainder(nn.Module):
    """`E2VID` behind its first layer; `padded`: (h, w) of its map."""

    def __init__(
        self,
        network: E2VID,
        positions: Sequence[Position],
        padded: tuple[int, int],
        dtype: torch.dtype,
    ):
        super().__init__()
        if (given := len(positions)) != (views := network.views):
            raise ValueError(f"optics.views must be {views} for this network, got {given}")
        self.views, self.stride = views, 1
        self.kernel, self.bias = (part.float().numpy() for part in network.first_layer.parameters())
        self.network, self.dtype = network.to(dtype), dtype
        with torch.no_grad():
            head = self._to_first(torch.zeros(1, *padded, len(self.kernel)))
            _, state = self.network.after_first_layer(head, None)
        leaves, self.structure = pytree.tree_flatten(state)
        self.initial_state = [torch.zeros_like(leaf) for leaf in leaves]

    def forward(self, head: Float[Tensor, "1 h w c"], *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame (1, 1, h, w), float32, and the tensors of the state."""
        before = pytree.tree_unflatten(state, self.structure)
        frame, after = self.network.after_first_layer(self._to_first(head), before)
        return frame.float(), *pytree.tree_leaves(after)

    def _to_first(self, head: Tensor) -> Tensor:
        return channels_first(head).to(self.dtype)


class SetNetRemainder(nn.Module):
    """`SetNet` behind its voxel kernels; `padded`: (h, w) of a grid, multiples of 8."""

    def __init__(
        self,
        network: SetNet,
        positions: Sequence[Position],
        padded: tuple[int, int],
        dtype: torch.dtype,
    ):
        super().__init__()
        self.views, self.stride = len(positions), CELL_PX
        places = network.checked_positions(self.views, network.bins, positions)
        kernel, _, bias = network.stem_kernels_and_bias(places)
        self.kernel, self.bias = kernel.numpy(), bias.numpy()
        # Of the sums only as many mixtures are convolved as their kernels have basis kernels.
        code, basis = network.sum_kernels.factors(torch.tensor(places).float())
        kernels = [basis.transpose(0, 1).flatten(1, 2), network.spread_conv.weight]
        self.code, self.mixture_kernel = code.numpy(), torch.cat(kernels, 1).to(dtype)
        self.initial_state = [torch.zeros(1, h, w, c) for c, h, w in network.map_sizes(*padded)]
        assert isinstance(network.memory, TimeGatedMemory)
        assert isinstance(network.pixel_conv, EqualDCConv)
        network.memory = SplitTimeGatedMemory(network.memory)
        network.pixel_conv = TwoByTwoCellConv(network.pixel_conv, CELL_PX)
        self.network, self.dtype = network.to(dtype), dtype

    def forward(
        self,
        voxel_map: Float[Tensor, "1 hc wc c"],
        mixtures: Float[Tensor, "1 hc wc mixtures"],
        elapsed_s: Float[Tensor, "1 1 1 1"],
        context_recency: Float[Tensor, "1 1 1 1"],
        hidden: Float[Tensor, "1 hc wc c"],
        context: Float[Tensor, "1 hq wq c"],
        context_smoothed: Float[Tensor, "1 hq wq c"],
    ) -> tuple[Tensor, ...]:
        """Return the pixels of every 2 x 2 cells (1, hq, wq, pixels), hidden, context and
        context_smoothed, all float32, of a window that updates the context.
        """
        stem = self.stem(voxel_map, mixtures)
        features, hidden = self.network.run_memory(stem, hidden, elapsed_s)
        pyramid = self.network.context
        new = pyramid(features).float()
        average = pyramid.moving_average(channels_first(context), new, context_recency)
        context = channels_last(average)
        pixels, smoothed = self.pixels(features, context, context_smoothed, elapsed_s)
        return pixels, hidden, context, smoothed

    def stem(self, voxel_map: Tensor, mixtures: Tensor) -> Tensor:
        """Return SetNet's stem, before its ReLU."""
        own, mixed = (channels_first(part.to(self.dtype)) for part in (voxel_map, mixtures))
        return own + functional.conv2d(mixed, self.mixture_kernel, None, 1, 1)

    def pixels(
        self, features: Tensor, context: Tensor, smoothed: Tensor, elapsed_s: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the pixels of every 2 x 2 cells and the smoothed context."""
        smoothed = smooth_context(smoothed, context, elapsed_s)
        pixels = self.network.decode_logits(features, channels_first(smoothed)).sigmoid()
        return channels_last(pixels), smoothed


class SetNetRemainderWithoutContext(nn.Module):
    """What of a SetNetRemainder a window takes that does not update the context."""

    def __init__(self, remainder: SetNetRemainder):
        super().__init__()
        self.remainder = remainder

    def forward(
        self, voxel_map: Tensor, mixtures: Tensor, elapsed_s: Tensor, hidden: Tensor,
        context: Tensor, context_smoothed: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        stem = self.remainder.stem(voxel_map, mixtures)
        features, hidden = self.remainder.network.run_memory(stem, hidden, elapsed_s)
        pixels, smoothed = self.remainder.pixels(features, context, context_smoothed, elapsed_s)
        return pixels, hidden, smoothed


class SplitTimeGatedMemory(nn.Module):
    """A TimeGatedMemory for one window: gate and candidate come from convolutions of their own, as
    splitting a map costs as much, and the state stays channels last.
    """

    def __init__(self, memory: TimeGatedMemory):
        super().__init__()
        self.input_features = memory.input_features
        self.input_gates = nn.ParameterList(memory.input_gates.weight.chunk(2))
        self.bias = nn.ParameterList(require_bias(memory.input_gates).chunk(2))
        self.state_gates = nn.ParameterList(memory.state_gates.weight.chunk(2))

    def forward(
        self, x: Float[Tensor, "1 c h w"], state: Float[Tensor, "1 h w c"], elapsed: Tensor
    ) -> tuple[Float[Tensor, "1 c h w"], Float[Tensor, "1 h w c"]]:
        """Return the state after the window, channels first and channels last."""
        before = channels_first(state.to(x.dtype))
        features = self.input_features(x)
        gate, candidate = (
            functional.conv2d(features, of_input, bias, padding=len(of_input[0, 0]) // 2)
            + functional.conv2d(before, of_state)
            for of_input, bias, of_state in zip(
                self.input_gates, self.bias, self.state_gates, strict=True
            )
        )
        keep = torch.exp(-elapsed * gate.relu().float())
        state = torch.lerp(candidate.tanh().float(), channels_first(state), keep)
        return state, channels_last(state)


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
        return functional.conv2d(x, self.weight, self.bias, 2)


class StatefulRunner:
    """Runs the remaining layers window by window and keeps their state.

    `inputs`: an example; `backend`: EagerBackend or CompiledModule of OpenVINO.
    """

    def __init__(
        self,
        remainder: E2VIDRemainder | SetNetRemainder,
        inputs: list[np.ndarray],
        backend: Callable[[nn.Module, list[Tensor], int], Any],
        threads: int,
    ):
        given, state = [*map(torch.from_numpy, inputs)], remainder.initial_state
        self.without_context_update = None
        if isinstance(remainder, SetNetRemainder):
            given.pop()  # whether an update is due
            reduced = SetNetRemainderWithoutContext(remainder)
            self.without_context_update = backend(reduced, [*given[:-1], *state], threads)
        self.whole = backend(remainder, [*given, *state], threads)
        self.inputs, self.state = len(given), list[Any]()
        self.reset()

    def __call__(self, inputs: list[np.ndarray]) -> np.ndarray:
        if self.without_context_update is None:
            output, *self.state = self.whole(inputs, self.state)
            return output
        *given, recency, update_due = inputs
        if update_due.any():
            output, *self.state = self.whole([*given, recency], self.state)
        else:
            _, context, _ = self.state
            output, hidden, smoothed = self.without_context_update(given, self.state)
            self.state = [hidden, context, smoothed]
        return output

    def reset(self) -> None:
        self.state = self.whole.zeros(self.inputs)


class EagerBackend:
    """A module on PyTorch: arrays and a state in, an array and a state out."""

    def __init__(self, module: nn.Module, example: list[Tensor], threads: int):
        self.module = module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.example, self.threads = example, threads

    @torch.inference_mode()
    def __call__(self, inputs: list[np.ndarray], state: list[Tensor]) -> list:
        with torch_threads(self.threads):
            output, *state = self.module(*map(torch.from_numpy, inputs), *state)
        return [output.numpy(), *state]

    def zeros(self, first: int) -> list[Tensor]:
        return [torch.zeros_like(part) for part in self.example[first:]]


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    return x.permute(0, 3, 1, 2)


def channels_last(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w c"]:
    return x.permute(0, 2, 3, 1)
