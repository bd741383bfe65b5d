"""What runs the remaining layers, with the state kept inside; PyTorch as one of its backends."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from src.deploy.cost import torch_threads
from src.deploy.remaining_layers import (
    E2VIDRemainder,
    SetNetRemainder,
    SetNetRemainderWithoutContext,
)


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
        """Return zeros for the inputs from the `first` on."""
        return [torch.zeros_like(part) for part in self.example[first:]]
