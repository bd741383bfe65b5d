"""Training on one batch until it is known by heart."""

from collections.abc import Callable

import torch
from torch import Tensor, nn


def learn_by_heart(
    network: nn.Module,
    draw: Callable[[], Tensor],
    target: Tensor,
    rate: float,
    steps: int,
    ratio: float,
) -> bool:
    """Return whether the mean square error of what `draw` makes falls below `ratio` of the first,
    five of Adam's steps in a row, in at most `steps`."""
    optimizer, losses = torch.optim.Adam(network.parameters(), rate), []
    for _ in range(steps):
        loss = (draw() - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
        if max(losses[-5:]) < ratio * losses[0]:
            return True
    return False
