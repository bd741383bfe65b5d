"""Parametrised weights (spectral norm) replaced by their values."""

from copy import deepcopy
from typing import TypeVar

from torch import nn
from torch.nn.utils import parametrize

Network = TypeVar("Network", bound=nn.Module)


def fold_parametrizations(network: nn.Module) -> None:
    """Replace every parametrised weight by its value, in place."""
    for module in network.modules():
        if parametrize.is_parametrized(module, "weight"):
            module.eval()  # else folding would take one more power iteration
            parametrize.remove_parametrizations(module, "weight")


def inference_copy(network: Network) -> Network:
    """Return a copy of `network` for inference only, its parametrisations folded."""
    copied = deepcopy(network).eval().requires_grad_(False)
    for module in copied.modules():
        if parametrize.is_parametrized(module):
            # A copy shares its class, of which folding takes the weight, with the original.
            kind = type(module)
            own = {k: v for k, v in vars(kind).items() if k not in ("__dict__", "__weakref__")}
            module.__class__ = type(kind.__name__, kind.__bases__, own)
    fold_parametrizations(copied)
    return copied
