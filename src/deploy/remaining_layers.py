"""The layers of an E2VID behind its first one, for one clip: a map in, frame and state out.

The map comes channels last, as events are added to it; `kernel`, `bias`, `stride` and `views` say
what the first layer is.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from src.deploy.cost import torch_threads
from src.models.e2vid import E2VID
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


class StatefulRunner:
    """Runs the remaining layers of an E2VID window by window and keeps their state.

    `inputs`: an example; `backend`: EagerBackend or CompiledModule of OpenVINO.
    """

    def __init__(
        self,
        remainder: E2VIDRemainder,
        inputs: list[np.ndarray],
        backend: Callable[[nn.Module, list[Tensor], int], Any],
        threads: int,
    ):
        given, state = [*map(torch.from_numpy, inputs)], remainder.initial_state
        self.whole = backend(remainder, [*given, *state], threads)
        self.inputs, self.state = len(given), list[Any]()
        self.reset()

    def __call__(self, inputs: list[np.ndarray]) -> Float[np.ndarray, "h w"]:
        """Return the frame, padded, valid until the next call."""
        output, *self.state = self.whole(inputs, self.state)
        return output[0, 0]

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

    @torch.inference_mode()
    def run(self, inputs: list[np.ndarray], outputs: list[np.ndarray]) -> None:
        """Write the outputs of a module that takes no state: arrays, contiguous and float32."""
        with torch_threads(self.threads):
            made = self.module(*map(torch.from_numpy, inputs))
        for part, output in zip(made if isinstance(made, tuple) else (made,), outputs, strict=True):
            output[...] = part.numpy()

    def zeros(self, first: int) -> list[Tensor]:
        return [torch.zeros_like(part) for part in self.example[first:]]


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    return x.permute(0, 3, 1, 2)
