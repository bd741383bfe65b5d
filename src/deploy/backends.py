"""What runs the layers behind the events; PyTorch as one of its backends."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.deploy.cost import torch_threads
from src.deploy.remaining_layers import E2VIDRemainder


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
        """Return zeros for the inputs from the `first` on."""
        return [torch.zeros_like(part) for part in self.example[first:]]
