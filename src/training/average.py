"""The weights' running mean, which is what a training validates, tests and ships."""

from copy import deepcopy

import torch
from torch import nn


def copy_of(network: nn.Module) -> nn.Module:
    """Return a copy of `network` to hold the mean: in eval mode, without gradients."""
    return deepcopy(network).eval().requires_grad_(False)


@torch.no_grad()
def follow(mean: nn.Module, network: nn.Module, decay: float, step: int) -> None:
    """Move every parameter of `mean` by a share 1 - decay towards `network`'s; copy its buffers.

    The first steps weigh more, 9 / (10 + step), so that the start is forgotten (as TensorFlow's
    ExponentialMovingAverage has it).
    """
    share = max(1 - decay, 9 / (10 + step))
    torch._foreach_lerp_(list(mean.parameters()), list(network.parameters()), share)
    for held, new in zip(mean.buffers(), network.buffers(), strict=True):
        held.copy_(new)
