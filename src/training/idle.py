"""Dead channels: outputs of kernels that no gradient reaches, as behind a ReLU that never opens."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn.utils import parametrize

if TYPE_CHECKING:
    from src.sim.pipeline import Sample
    from src.training.reconstructor import Reconstructor

WINDOWS = 16  # of a clip that the gradient comes from


def idle_share(module: "Reconstructor", samples: Iterable["Sample"]) -> float:
    """Return the share, 0 to 1, of the output channels of the kernels of the network in training
    that get no gradient of the mean error over the first WINDOWS of each clip.
    """
    network, training = module.network, module.network.training
    network.eval().zero_grad()
    for sample in samples:
        with torch.enable_grad(), parametrize.cached():
            frames, _ = module.unrolled(sample, slice(WINDOWS))
            (frames - sample.target[:, :WINDOWS]).abs().mean().backward()
    silent = [_silent(part) for part in network.parameters() if part.ndim == 4]
    network.train(training).zero_grad()
    return float(torch.cat(silent).float().mean()) if silent else 0.0


def _silent(kernel: nn.Parameter) -> torch.Tensor:
    if kernel.grad is None:
        return kernel.new_ones(len(kernel), dtype=torch.bool)
    return (kernel.grad == 0).flatten(1).all(1)
