"""Kernels of SetNet's first layers: functions of the positions of the views."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

KERNEL_RANKS = 5  # basis kernels that the position of a view weighs, beside one of all views


class ViewKernels(nn.Module):
    """Makes the kernel of a convolution over stacked views from the positions of the views.

    kernel(position) = (basis_0 + sum_r code_r(position, views) basis_r) / views, code an MLP: with
    as many ranks as views it can equal any convolution of the stacked views of one layout.
    """

    def __init__(self, inputs: int, outputs: int, kernel_size: int):
        super().__init__()
        shape = ((KERNEL_RANKS + 1) * outputs, inputs, kernel_size, kernel_size)
        bound = 1 / math.sqrt(inputs * kernel_size**2)
        self.basis = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.code = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, KERNEL_RANKS))

    def kernel(
        self, positions: Float[Tensor, "views 2"]
    ) -> Float[Tensor, "outputs viewsinputs size size"]:
        """Return the kernel for the stacked views at `positions` (row, col)."""
        code, basis = self.factors(positions)
        return torch.einsum("vr,roikl->ovikl", code, basis).flatten(1, 2)

    def factors(
        self, positions: Float[Tensor, "views 2"]
    ) -> tuple[Float[Tensor, "views basis"], Float[Tensor, "basis outputs inputs size size"]]:
        """Return the coefficients (1, code) / views of each view and the basis kernels."""
        views = len(positions)
        # Inputs of the MLP, of order 1: row, column, and 3 / views.
        known = torch.cat([positions, torch.full_like(positions[:, :1], 3 / views)], 1)
        code = self.code(known.to(self.bias.dtype))
        code = torch.cat([torch.ones_like(code[:, :1]), code], 1) / views
        return code, self.basis.unflatten(0, (code.shape[1], -1))
