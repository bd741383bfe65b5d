"""Where a Hilbert curve meets the cells of a box, so that neighbours in it are neighbours there."""

from functools import lru_cache

import torch
from jaxtyping import Int
from torch import Tensor


@lru_cache(maxsize=16)
def hilbert_order(*sides: int) -> Int[Tensor, " cells"]:
    """Return the flat (row-major) indices of a box in the order of the curve through it.

    The curve fills the smallest cube of side 2**k around the box (Skilling 2004, AIP Conf. Proc.
    707); cells outside are left out, so it jumps where a side is no power of two.
    """
    bits = max(1, (max(sides) - 1).bit_length())
    grids = torch.meshgrid(*(torch.arange(side) for side in sides), indexing="ij")
    axes = [grid.flatten() for grid in grids]
    level = 1 << (bits - 1)
    while level > 1:  # undo, from the coarsest cubes inwards, how each cube was turned
        for i in range(len(axes)):
            turned = (axes[i] & level) > 0
            swapped = torch.where(turned, 0, (axes[0] ^ axes[i]) & (level - 1))
            axes[0] = torch.where(turned, axes[0] ^ (level - 1), axes[0] ^ swapped)
            if i:
                axes[i] = axes[i] ^ swapped
        level >>= 1
    index, axes = torch.zeros_like(axes[0]), _gray(axes, bits)
    for bit in reversed(range(bits)):
        for axis in axes:
            index = (index << 1) | ((axis >> bit) & 1)
    return torch.argsort(index)


def _gray(axes: list[Tensor], bits: int) -> list[Tensor]:
    """Return the axes in Gray code, all along one line."""
    for i in range(1, len(axes)):
        axes[i] = axes[i] ^ axes[i - 1]
    flips = torch.zeros_like(axes[0])
    for bit in range(bits - 1, 0, -1):
        flips = torch.where((axes[-1] >> bit) & 1 > 0, flips ^ ((1 << bit) - 1), flips)
    return [axis ^ flips for axis in axes]
