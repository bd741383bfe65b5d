"""SetNet's context where it is updated: its layers, on tiles or whole maps, and how tiles are cut.

A convolution at the border of the frame takes in zeros; a tile that reaches over it has zeros there
before each of its convolutions.
"""

from copy import deepcopy
from functools import lru_cache
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.nn import functional

from src.deploy.engines import tiles_numba
from src.deploy.setnet_clock import ContextUpdate, list_nonzero_cells, max_of_squares
from src.deploy.setnet_layers import channels_first, channels_last, unpadded
from src.deploy.tile_batches import TileModule
from src.models.context_pyramid import ContextPyramid
from src.models.layers import PreActivationBlock
from src.models.setnet import SetNet

BLOCK_HALO = 2  # cells that the two convolutions of a PreActivationBlock take in on each side
CONTEXT_TILE = 8  # side of a tile of any scale, in its cells
CONTEXT_BATCHES = (16,)  # sizes of batches, in tiles


class WholeContext(nn.Module):
    """An update of the context on whole maps: ContextPyramid and its moving average."""

    def __init__(self, network: SetNet, dtype: torch.dtype):
        super().__init__()
        self.pyramid, self.dtype = deepcopy(network.context).to(dtype), dtype

    def forward(
        self,
        hidden: Float[Tensor, "1 h2 w2 c"],
        context: Float[Tensor, "1 h4 w4 c"],
        recency: Float[Tensor, "1 h4 w4 1"],
        is_updated: Float[Tensor, "1 h4 w4 1"],
        *held: Float[Tensor, "1 _h _w _c"],
    ) -> tuple[Tensor, ...]:
        """Return the context and the held maps after the update."""
        pyramid, remaining, after = self.pyramid, list(held), list[Tensor]()
        masks, x, finer = [channels_first(is_updated)], channels_first(hidden.to(self.dtype)), []
        for _ in pyramid.downs[1:]:
            masks.append(functional.max_pool2d(masks[-1], 2, ceil_mode=True))

        def hold(new: Tensor, mask: Tensor) -> Tensor:
            # Channels last: OpenVINO would transpose all that are selected from.
            now = torch.where(channels_last(mask) > 0, channels_last(new.float()), remaining.pop(0))
            after.append(now)
            return channels_first(now.to(self.dtype))

        for down, block, mask in zip(pyramid.downs, pyramid.down_blocks, masks, strict=True):
            x = hold(block(down(x)), mask)
            finer.append(x)
        finer.pop()
        for scale in reversed(range(len(finer))):
            x = pyramid.fuse(x, finer[scale], scale)
            x = hold(x, masks[scale]) if scale else x
        new = channels_last(pyramid.ups[0](x.relu()).float())
        keep = torch.exp(pyramid.log_rate.float().exp().flatten() * recency.log())
        context = torch.where(is_updated > 0, torch.lerp(new, context, keep), context)
        return context, *after


class ScaleLayers(nn.Module):
    """One scale of a ContextPyramid on tiles: from the finer map, with a halo of 5 of its cells
    behind and 4 before."""

    def __init__(self, pyramid: ContextPyramid, scale: int, dtype: torch.dtype):
        super().__init__()
        self.down = unpadded(pyramid.downs[scale]).to(dtype)
        self.block, self.dtype = TileBlock(pyramid.down_blocks[scale]).to(dtype), dtype

    def forward(
        self, x: Float[Tensor, "b s s c"], is_inside: Float[Tensor, "b t t 1"]
    ) -> Float[Tensor, "b u u d"]:
        """Return the map of the scale; `is_inside`: 1 in cells of the frame, with a halo of 2."""
        inside = channels_first(is_inside.to(self.dtype))
        new = self.block(self.down(channels_first(x.to(self.dtype))), inside)
        return channels_last(new).float()


class FusionLayers(nn.Module):
    """A scale of a ContextPyramid and the next coarser one, added on tiles with a halo of `halo`;
    behind the finest the update of the context."""

    def __init__(self, pyramid: ContextPyramid, scale: int, dtype: torch.dtype):
        super().__init__()
        block = pyramid.fusion_blocks[scale]
        is_block = isinstance(block, PreActivationBlock)
        self.halo = BLOCK_HALO if is_block else 0
        self.block = TileBlock(block).to(dtype) if is_block else None
        self.up, self.dtype = deepcopy(pyramid.ups[scale + 1]).to(dtype), dtype

    def forward(
        self,
        finer: Float[Tensor, "b t t c"],
        coarser: Float[Tensor, "b t t d"],
        is_inside: Float[Tensor, "b t t 1"],
    ) -> Float[Tensor, "b u u c"]:
        """Return the sum; `coarser`: after its ReLU, interpolated to the cells of `finer`."""
        return channels_last(self.fuse(finer, coarser, is_inside)).float()

    def fuse(self, finer: Tensor, coarser: Tensor, is_inside: Tensor) -> Tensor:
        finer, coarser, inside = (
            channels_first(part.to(self.dtype)) for part in (finer, coarser, is_inside)
        )
        new = finer + self.up(coarser)
        return new if self.block is None else self.block(new, inside)


class ContextUpdateLayers(FusionLayers):
    """The FusionLayers of the finest scale, and the update of the context from their sum."""

    def __init__(self, pyramid: ContextPyramid, scale: int, dtype: torch.dtype):
        super().__init__(pyramid, scale, dtype)
        self.last, self.rate = deepcopy(pyramid.ups[0]).to(dtype), pyramid.log_rate.float().exp()

    def forward(  # type: ignore[override]
        self,
        finer: Float[Tensor, "b t t c"],
        coarser: Float[Tensor, "b t t d"],
        is_inside: Float[Tensor, "b t t 1"],
        context: Float[Tensor, "b u u o"],
        recency: Float[Tensor, "b u u 1"],
    ) -> Float[Tensor, "b u u o"]:
        """Return the context after the update."""
        new = self.last(self.fuse(finer, coarser, is_inside).relu()).float()
        keep = channels_first(recency) ** self.rate
        return channels_last(torch.lerp(new, channels_first(context), keep))


class TileBlock(nn.Module):
    """A PreActivationBlock on tiles: what is outside the frame is zero before each convolution."""

    def __init__(self, block: nn.Module):
        super().__init__()
        assert isinstance(block, PreActivationBlock)
        self.conv1, self.conv2 = unpadded(block.conv1), unpadded(block.conv2)

    def forward(
        self, x: Float[Tensor, "b c t t"], inside: Float[Tensor, "b 1 t t"]
    ) -> Float[Tensor, "b c u u"]:
        y = self.conv1(x.relu() * inside)
        y = self.conv2(y.relu() * inside[..., 1:-1, 1:-1])
        return x[..., BLOCK_HALO:-BLOCK_HALO, BLOCK_HALO:-BLOCK_HALO] + y


class ContextTiles:
    """Updates the context of a TileState, scale by scale.  Raises ValueError for a single scale."""

    def __init__(self, network: SetNet, dtype: torch.dtype, *how: Any):
        pyramid = network.context
        widths = [c for c, *_ in pyramid.held_map_sizes(2, 2)[: len(pyramid.downs)]]
        if len(widths) < 2:
            raise ValueError(f"context_channels must be at least 2 for event lists, got {widths}")
        how = *how, CONTEXT_BATCHES
        inner, outer = CONTEXT_TILE + 2 * BLOCK_HALO, 2 * (CONTEXT_TILE + 2 * BLOCK_HALO) + 1
        self.down, self.fuse = list[TileModule](), list[TileModule]()
        for scale, channels in enumerate([network.channels, *widths[:-1]]):
            shapes = [(outer, outer, channels), (inner, inner, 1)]
            self.down.append(TileModule(ScaleLayers(pyramid, scale, dtype), shapes, *how))
        for scale, (finer, coarser) in enumerate(pairwise(widths)):
            kind = FusionLayers if scale else ContextUpdateLayers
            layers = kind(pyramid, scale, dtype)
            self.halo = layers.halo
            side = CONTEXT_TILE + 2 * layers.halo
            shapes = [(side, side, n) for n in (finer, coarser, 1)]
            if not scale:
                shapes += [(CONTEXT_TILE, CONTEXT_TILE, n) for n in (network.channels, 1)]
            self.fuse.append(TileModule(layers, shapes, *how))

    def update(self, state: Any, update: ContextUpdate) -> None:
        """Bring the context of `state`, a TileState, up to date in the cells of `update`."""
        corners = [find_tiles(cells) for cells in update.cells]
        finer = [state.hidden, *state.scales]
        for scale, module in enumerate(self.down):
            self._make_scale(
                module, finer[scale], corners[scale], update.cells[scale], state.scales[scale]
            )
        for scale in reversed(range(len(self.fuse))):
            self._fuse(scale, state, corners[scale], update)

    def _make_scale(self, module: TileModule, source, corners, cells, target) -> None:
        frame = np.ones((*target.shape[:2], 1), np.float32)

        def read(part: slice, inputs: list[np.ndarray]) -> None:
            x, inside = inputs
            tiles_numba.gather(source, 2 * corners[part] - np.int32(2 * BLOCK_HALO + 1), x)
            tiles_numba.gather(frame, corners[part] - np.int32(BLOCK_HALO), inside)

        def write(part: slice, made: np.ndarray) -> None:
            tiles_numba.scatter(made, corners[part], cells, target)

        module.run(len(corners), read, write)

    def _fuse(self, scale, state, corners, update) -> None:
        finer, coarser = state.scales[scale], state.fused[scale + 1]
        target = state.fused[scale] if scale else state.context
        frame = np.ones((*finer.shape[:2], 1), np.float32)
        rows, columns = map(interpolation_spans, coarser.shape[:2], finer.shape[:2])

        def read(part: slice, inputs: list[np.ndarray]) -> None:
            first = corners[part] - np.int32(self.halo)
            tiles_numba.gather(finer, first, inputs[0])
            tiles_numba.gather_interpolated(coarser, rows, columns, first, inputs[1])
            tiles_numba.gather(frame, first, inputs[2])
            if not scale:
                tiles_numba.gather(state.context, corners[part], inputs[3])
                tiles_numba.gather(update.recency[..., None], corners[part], inputs[4])

        def write(part: slice, made: np.ndarray) -> None:
            tiles_numba.scatter(made, corners[part], update.cells[scale], target)

        self.fuse[scale].run(len(corners), read, write)


def find_tiles(mask: UInt8[np.ndarray, "_h _w"]) -> Int[np.ndarray, "n 2"]:
    """Return first row and column of the tiles of a scale that have a cell of `mask`."""
    return np.int32(CONTEXT_TILE) * list_nonzero_cells(max_of_squares(mask, CONTEXT_TILE))


@lru_cache(64)
def interpolation_spans(coarse: int, fine: int) -> Float[np.ndarray, "fine 3"]:
    """Return, for each place of a bilinear interpolation, two places to take and the weight of the
    second, as torch does without align_corners."""
    place = np.maximum((np.arange(fine) + 0.5) * np.float32(coarse / fine) - 0.5, 0)
    first = place.astype(int)
    second = np.minimum(first + 1, coarse - 1)
    return np.stack([first, second, place - first], 1).astype(np.float32)
