"""A network over a sequence of windows."""

from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn


def unroll(
    network: nn.Module, voxels: Float[Tensor, "n windows views bins h w"], state: Any = None
) -> tuple[Float[Tensor, "n windows 1 h w"], Any]:
    """Return the frame of every window and the state after the last one."""
    frames = []
    for window in voxels.unbind(1):
        frame, state = network(window, state)
        frames.append(frame)
    return torch.stack(frames, dim=1), state


def chunks(windows: int, length: int) -> Iterator[slice]:
    """Yield slices of at most `length` windows (0: all at once) that cover `windows`."""
    length = length or windows
    for start in range(0, windows, length):
        yield slice(start, min(start + length, windows))


def detach(state: Any) -> Any:
    """Return `state`, a tensor or nested tuples, lists and dicts of tensors, cut from its graph."""
    if isinstance(state, Tensor):
        return state.detach()
    if isinstance(state, tuple | list):
        return type(state)(detach(part) for part in state)
    if isinstance(state, dict):
        return {name: detach(part) for name, part in state.items()}
    return state
