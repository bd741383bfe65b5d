"""The first layer of a network as events make it, one by one, and an E2VID on top of it.

A convolution is linear: an event adds the part of the kernel that reaches from where it fell, its
patch, to the map.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from src.deploy.engines import events_numba as kernels
from src.deploy.setnet_layers import channels_first
from src.deploy.tile_batches import Backend
from src.models.e2vid import E2VID


class E2VIDRemainder(nn.Module):
    """`E2VID` behind its first layer, of stride 1, kernel `kernel` and bias `bias`, for one clip;
    `padded`: (h, w) of its map, channels last, as events are added to it.
    """

    def __init__(self, network: E2VID, padded: tuple[int, int], dtype: torch.dtype):
        super().__init__()
        self.kernel, self.bias = (part.float().numpy() for part in network.first_layer.parameters())
        self.network, self.dtype = network.to(dtype), dtype
        with torch.no_grad():
            head = torch.zeros(1, *padded, len(self.kernel), dtype=torch.float32)
            _, state = self.network.after_first_layer(self._to_first(head), None)
        leaves, self.structure = pytree.tree_flatten(state)
        self.example = [head, *(torch.zeros_like(leaf) for leaf in leaves)]  # inputs of `forward`

    def forward(self, head: Float[Tensor, "1 h w c"], *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame (1, 1, h, w), float32, and the tensors of the state."""
        before = pytree.tree_unflatten(state, self.structure)
        frame, after = self.network.after_first_layer(self._to_first(head), before)
        return frame.float(), *pytree.tree_leaves(after)

    def _to_first(self, head: Tensor) -> Tensor:
        return channels_first(head).to(self.dtype)


class E2VIDOverEvents:
    """An E2VID over windows of events, its state kept; `padded`: (h, w) of a grid."""

    def __init__(
        self, network: E2VID, padded: tuple[int, int], dtype: torch.dtype, backend: Backend,
        threads: int,
    ):  # fmt: skip
        remainder, (height, width) = E2VIDRemainder(network, padded, dtype), padded
        kernel = remainder.kernel
        self.patches = event_patches(kernel, network.views, 1)
        self.row_spans, self.column_spans = (
            output_spans_of_inputs(side, 1, kernel.shape[-1]) for side in padded
        )
        self.bias, self.shape = np.tile(remainder.bias, width), (1, height, width, len(kernel))
        self.remainder = backend(remainder, remainder.example, threads)
        self.state = list[Any]()
        self.reset()

    def collect_events(
        self, t, x, y, p, view, t0: float, t1: float
    ) -> Float[np.ndarray, "1 h w c"]:
        """Return the map of the first layer of a window's events; `t`, `t0`, `t1` in seconds."""
        made = np.empty((self.shape[1], self.bias.size), np.float32)
        made[:] = self.bias
        patch = self.row_spans, self.column_spans, self.patches
        kernels.add_patches(t, x, y, p, view, t0, t1, *patch, made)
        return made.reshape(self.shape)

    def __call__(self, first: Float[np.ndarray, "1 h w c"]) -> Float[np.ndarray, "h w"]:
        """Return the frame, padded, valid until the next call."""
        output, *self.state = self.remainder([first], self.state)
        return output[0, 0]

    def is_settled(self, state: Any) -> bool:
        return True  # see EventToVideoNetwork

    def advance_without_events(self, state: Any, seconds: float) -> Any:
        return state

    def reset(self) -> None:
        self.state = self.remainder.zeros(1)


def event_patches(
    kernel: Float[np.ndarray, "c viewsbins k k"], views: int, stride: int
) -> Float[np.ndarray, "views bins stride stride reach reachc"]:
    """Return what an event adds to the map: [view, bin, row % stride, column % stride], first row
    first, and in a row first column first, each with all its channels.
    """
    channels, _, size, _ = kernel.shape
    stacked = kernel.reshape(channels, views, -1, size, size).transpose(1, 2, 3, 4, 0)
    reach, half = -(-size // stride), size // 2
    # An output at `first + i` sees the event at place - stride * (first + i) + half of its kernel.
    place = np.arange(stride)[:, None]
    seen = place + half - stride * (_first_output(place, stride, half) + np.arange(reach))
    down, right = seen[:, None, :, None], seen[None, :, None, :]
    is_seen = ((down >= 0) & (right >= 0))[..., None]
    made = np.where(is_seen, stacked[:, :, down, right], np.float32(0))
    return np.ascontiguousarray(made.reshape(*made.shape[:5], reach * channels))


def output_spans_of_inputs(side: int, stride: int, size: int) -> Int[np.ndarray, "side 3"]:
    """Return for each place along an axis (first output, first of the patch, how many outputs) of
    a convolution of `size`, padded by size // 2: at the edges a part of the patch falls outside.
    """
    place = np.arange(side)
    first, last = _first_output(place, stride, size // 2), (place + size // 2) // stride
    begin, end = np.maximum(first, 0), np.minimum(last, side // stride - 1)
    return np.stack([begin, begin - first, end - begin + 1], 1)


def _first_output(place: Any, stride: int, half: int) -> Any:
    return -((half - place) // stride)
