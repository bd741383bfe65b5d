"""Dead channels: outputs of kernels that no gradient reaches, as behind a ReLU that never opens."""

from collections.abc import Iterable
from copy import deepcopy
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn.utils import parametrize

from src.models.unroll import video

if TYPE_CHECKING:
    from src.sim.pipeline import Sample

WINDOWS = 16  # of a clip that the gradient comes from


def idle_share(network: nn.Module, samples: Iterable["Sample"]) -> float:
    """Return the share, 0 to 1, of the output channels of `network`'s kernels that get no gradient
    of the mean error over the first WINDOWS of each clip.
    """
    probe = deepcopy(network).eval().requires_grad_()
    for sample in samples:
        parts = {name: getattr(sample, name)[:, :WINDOWS] for name in ("voxels", "target")}
        with torch.enable_grad(), parametrize.cached():
            frames = video(probe, replace(sample, **parts))
            (frames - parts["target"]).abs().mean().backward()
    kernels = [part for part in probe.parameters() if part.ndim == 4]
    if not kernels:
        return 0.0
    return float(torch.cat([_silent(kernel) for kernel in kernels]).float().mean())


def _silent(kernel: nn.Parameter) -> torch.Tensor:
    if kernel.grad is None:
        return torch.ones(len(kernel), dtype=torch.bool)
    return (kernel.grad == 0).flatten(1).all(1)
