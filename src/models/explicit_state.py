"""A network whose state is a flat list of tensors, as what runs outside PyTorch wants it."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from src.models.unroll import takes


class Explicit(nn.Module):
    """`network` with its state as explicit inputs and outputs, for one clip at a time."""

    def __init__(self, network: nn.Module, positions: Sequence[tuple[int, int]] | None):
        super().__init__()
        self.network, self.form = network, None
        self.options = {"positions": positions} if takes(network, "positions") else {}
        self.timed = takes(network, "window_s")

    def begin(self, voxels: Tensor) -> list[Tensor]:
        """Return the state before the first window, zeros, and note its form."""
        _, self.form = self.network(voxels, None, **self.options)
        return [torch.zeros_like(part) for part in flat(self.form)]

    def forward(self, voxels: Tensor, window_s: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
        """Return the frame and the parts of the new state; `window_s` (1,) is in seconds."""
        options = self.options | ({"window_s": window_s} if self.timed else {})
        frame, after = self.network(voxels, formed(self.form, iter(state)), **options)
        return frame, *flat(after)


def flat(state: Any) -> list[Tensor]:
    """Return the tensors of nested tuples, lists and dicts in order."""
    if isinstance(state, Tensor):
        return [state]
    parts = state.values() if isinstance(state, dict) else state
    return [tensor for part in parts for tensor in flat(part)]


def formed(form: Any, tensors: Iterator[Tensor]) -> Any:
    """Return `tensors` nested as `form` is."""
    if isinstance(form, Tensor):
        return next(tensors)
    if isinstance(form, dict):
        return {name: formed(part, tensors) for name, part in form.items()}
    return type(form)(formed(part, tensors) for part in form)
