"""What a network costs: multiply-accumulates of one frame."""

from collections.abc import Callable, Sequence

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from src.models.unroll import accepted
from src.sim.optics import Position


@torch.no_grad()
def macs_per_frame(
    network: nn.Module,
    height: int,
    width: int,
    *,
    views: int = 1,
    bins: int = 5,
    positions: Sequence[Position] | None = None,
) -> int:
    """Return the multiply-accumulates of one window, batch 1, state carried.

    `positions`: (row, col) of each view, None: `optics.layout`.  Counted are convolutions and
    matrix products (torch's FLOP counter, two FLOPs a MAC), not elementwise work and interpolation.
    """
    device = next((parameter.device for parameter in network.parameters()), torch.device("cpu"))
    voxels = torch.zeros(1, views, bins, height, width, device=device)
    options = accepted(network, positions=positions)
    _, state = network(voxels, None, **options)
    return macs(lambda: network(voxels, state, **options))


def macs(work: Callable[[], object]) -> int:
    """Return the multiply-accumulates of convolutions and matrix products in a call of `work`."""
    with FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops() // 2
