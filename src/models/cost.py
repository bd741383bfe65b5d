"""What a network costs: multiply-accumulates of one frame."""

from collections.abc import Callable

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode


@torch.no_grad()
def macs_per_frame(
    network: nn.Module, height: int, width: int, *, views: int = 1, bins: int = 5
) -> int:
    """Return the multiply-accumulates of one window, batch 1, state carried.

    Counted are convolutions and matrix products (torch's FLOP counter, two FLOPs a MAC), not
    elementwise work and interpolation.
    """
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    voxels = torch.zeros(1, views, bins, height, width, device=device)
    _, state = network(voxels, None)
    return macs(lambda: network(voxels, state))


def macs(work: Callable[[], object]) -> int:
    """Return the multiply-accumulates of convolutions and matrix products in a call of `work`."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() // 2
