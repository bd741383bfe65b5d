"""SetNet's context: a pyramid of coarser maps, updated where it is due and smoothed in time."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models.layers import PreActivationBlock, init_kaiming, init_zero, scan_windows

CONTEXT_TAU_S = 1 / 60  # time constant of the low-pass on the context
INITIAL_CONTEXT_RATE = 0.9  # initial decay rate of the moving average, per CONTEXT_INTERVAL_S


class ContextPyramid(nn.Module):
    """A feature pyramid: one stride-2 convolution and residual block for each of `widths`
    (channels), then the coarser scales are added to the finer ones, up to half the input's size.

    Residual sums have no ReLU after them (He et al. 2016, identity mappings) and the output starts
    at zero: otherwise a high learning rate leaves dead ReLUs.  `refine_fusion`: a
    residual block also after each sum of two scales.
    """

    def __init__(self, channels: int, widths: Sequence[int], refine_fusion: bool = False):
        super().__init__()
        pairs = list(pairwise([channels, *widths]))
        downs = [init_kaiming(nn.Conv2d(a, b, 3, 2, padding=1)) for a, b in pairs]
        self.down_blocks = nn.ModuleList(PreActivationBlock(width) for width in widths)
        ups = [init_kaiming(nn.Conv2d(b, a, 1)) for a, b in pairs]
        init_zero(ups[0])
        self.downs, self.ups = nn.ModuleList(downs), nn.ModuleList(ups)
        self.fusion_blocks = nn.ModuleList(
            PreActivationBlock(width) if refine_fusion else nn.Identity() for width in widths[:-1]
        )
        self.relu = nn.ReLU()
        initial = torch.full((channels, 1, 1), math.log(INITIAL_CONTEXT_RATE))
        self.log_rate = nn.Parameter(initial)  # log decay rate of the moving average, per channel

    def held_map_sizes(self, rows: int, columns: int) -> list[tuple[int, int, int]]:
        """Return the sizes (c, h, w) of the maps that are held: those of the scales, finest first,
        then the sums with the coarser ones but the finest, coarsest first."""
        sizes = []
        for down in self.downs:
            rows, columns = -(-rows // 2), -(-columns // 2)
            assert isinstance(down, nn.Conv2d)
            sizes.append((down.out_channels, rows, columns))
        return [*sizes, *reversed(sizes[1:-1])]

    def forward(
        self, x: Float[Tensor, "m c h2 w2"], held: tuple[Tensor, ...], is_updated: Tensor
    ) -> tuple[Float[Tensor, "m c h4 w4"], tuple[Tensor, ...]]:
        """Return a map of half the size of `x` (m = windows * n), and the held maps after the last
        window.  Each map changes only in cells over one that `is_updated` (m, 1, h2, w2).
        """
        due = None
        # Shapes that depend on data would synchronise a GPU, and no exported model has them.
        if not x.is_cuda and not torch.jit.is_tracing() and not torch.compiler.is_compiling():
            due = is_updated.flatten(1).any(1).nonzero().flatten()
        masks, mask = [], is_updated.float()
        for _ in self.downs:
            mask = functional.max_pool2d(mask, 2, ceil_mode=True)
            masks.append(mask > 0)
        remaining, after, scales = list(held), [], []
        for down, block, mask in zip(self.downs, self.down_blocks, masks, strict=True):
            new = _run_on(due, lambda x, d=down, b=block: b(d(x)), x)
            x, last = scan_windows(_hold, remaining.pop(0), new, mask)
            x = x.to(new.dtype)
            scales.append(x)
            after.append(last)
        scales.pop()
        for scale in reversed(range(len(scales))):
            new = _run_on(due, lambda x, f, k=scale: self.fuse(x, f, k), x, scales[scale])
            x = new
            if scale:
                x, last = scan_windows(_hold, remaining.pop(0), new, masks[scale])
                x = x.to(new.dtype)
                after.append(last)
        return _run_on(due, lambda x: self.ups[0](self.relu(x)), x), tuple(after)

    def fuse(self, x: Tensor, finer: Tensor, scale: int) -> Tensor:
        """Return the sum of a scale, `finer`, and `x` of the next coarser one, refined."""
        x = self.ups[scale + 1](self.relu(x))
        coarser = functional.interpolate(x, finer.shape[-2:], mode="bilinear")
        return self.fusion_blocks[scale](finer + coarser)


def smooth_context(smoothed: Tensor, context: Tensor, elapsed_s: Tensor) -> Tensor:
    """Return `smoothed` after a first-order low-pass step of `elapsed_s` toward `context`."""
    return torch.lerp(context, smoothed, torch.exp(-elapsed_s / CONTEXT_TAU_S))


def _hold(before: Tensor, new: Tensor, is_updated: Tensor) -> Tensor:
    return torch.where(is_updated, new.float(), before)


def _run_on(due: Tensor | None, work: Callable[..., Tensor], *maps: Tensor) -> Tensor:
    """Return work(*maps) for the entries `due` (None: all) and zeros for the others."""
    if due is None:
        return work(*maps)
    some = work(*(part[due] for part in maps))
    return some.new_zeros(len(maps[0]), *some.shape[1:]).index_copy(0, due, some)
