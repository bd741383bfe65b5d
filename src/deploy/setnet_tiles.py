"""The second half of a SetNet's window: the layers behind its events, on tiles that change."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.deploy.engines import tiles_numba
from src.deploy.engines.clock_numba import QUARTER, TILE
from src.deploy.setnet_clock import BegunWindow, ContextUpdate
from src.deploy.setnet_layers import (
    BLOCK_HALO,
    ContextLayers,
    DecoderLayers,
    FusionLayers,
    MemoryLayers,
    ScaleLayers,
)
from src.deploy.tile_batches import TileModule
from src.models.setnet import CELL_PX, SetNet

CONTEXT_TILE = 8  # side of a tile of any scale of the context, in its cells
Backend = Callable[[nn.Module, list[Tensor], int], Any]


class TileState:
    """What lives from window to window, advanced in place: maps (rows, columns, channels) and the
    frame (h, w)."""

    def __init__(self, network: SetNet, height: int, width: int, start: float):
        rows, columns = height // CELL_PX, width // CELL_PX
        hidden, context, _ = network.map_sizes(height, width)
        scales = network.context.map_sizes(rows, columns)
        self.hidden, self.context, self.smoothed = map(_zeros, (hidden, context, context))
        levels = len(network.context.downs)
        self.scales = [_zeros(size) for size in scales[:levels]]
        # The sums with coarser scales, by scale; the coarsest has none, the finest is not held.
        self.fused = [None, *map(_zeros, reversed(scales[levels:])), self.scales[-1]]
        self.frame = np.full((height, width), start, np.float32)


class SetNetTiles:
    """Brings a TileState forward, window by window.  `padded`: (h, w) of a picture; `memory`: see
    MemoryLayers."""

    def __init__(
        self, network: SetNet, memory: MemoryLayers, padded: tuple[int, int], dtype: torch.dtype,
        backend: Backend, threads: int,
    ):  # fmt: skip
        self.network, self.padded = network, padded
        c, near, far = network.channels, TILE + 2, TILE + 4
        mixtures = memory.kernel.shape[1]
        shapes = [(near, near, c), (far, far, mixtures), (near, near, 1), (TILE, TILE, c)]
        self.memory = TileModule(memory, shapes, backend, threads)
        decoder = DecoderLayers(network, dtype, False)
        self.decoder = TileModule(decoder, [(far, far, c)], backend, threads)
        self.context = ContextTiles(network, dtype, backend, threads)
        # Where no event was ever seen every pixel is that of maps of zeros.
        self.start = float(self.decoder.run(4, [np.zeros((4, far, far, c), np.float32)])[0, 0, 0, 0])
        self.reset()

    def reset(self) -> None:
        self.state = TileState(self.network, *self.padded, self.start)

    def __call__(self, begun: BegunWindow) -> Float[np.ndarray, "h w"]:
        """Return the frame, padded, valid until the next window."""
        state = self.state
        self._remember(begun)
        if begun.update:
            self.context.update(state, begun.update)
        corners = QUARTER * begun.smoothed_tiles
        cells = begun.smoothed_cells, begun.smoothing_kept
        tiles_numba.smooth(state.context, corners, *cells, state.smoothed)
        self._draw(begun.changed_tiles)
        return state.frame

    def _remember(self, begun: BegunWindow) -> None:
        corners, hidden = TILE * begun.tiles, self.state.hidden
        for part, size, (*_, before) in self.memory.batches(len(corners)):
            tiles_numba.gather(hidden, corners[part], before)
            padded = slice(part.start, part.start + size)
            given = [x[padded] for x in (begun.voxel_map, begun.mixtures, begun.elapsed_s)]
            after = self.memory.run(size, [*given, before])
            tiles_numba.scatter_active(after, corners[part], begun.elapsed_s[part], hidden)

    def _draw(self, tiles: np.ndarray) -> None:
        state, halo = self.state, np.int32(DecoderLayers.HALO)
        for part, size, (seen,) in self.decoder.batches(len(tiles)):
            corners = TILE * tiles[part]
            tiles_numba.gather_sum(state.hidden, state.smoothed, corners - halo, seen)
            pixels = self.decoder.run(size, [seen])
            squares = QUARTER * tiles[part], 2 * CELL_PX
            tiles_numba.write_pixels(pixels, *squares, state.frame)


class ContextTiles:
    """Updates the context of a TileState, scale by scale.  Raises ValueError for a single scale."""

    def __init__(self, network: SetNet, dtype: torch.dtype, backend: Backend, threads: int):
        pyramid = network.context
        widths = [down.out_channels for down in pyramid.downs]
        inner, outer = CONTEXT_TILE + 2 * BLOCK_HALO, 2 * (CONTEXT_TILE + 2 * BLOCK_HALO) + 1
        self.down, self.fuse = [], []
        for scale, channels in enumerate([network.channels, *widths[:-1]]):
            layers = ScaleLayers(pyramid, scale, dtype)
            shapes = [(outer, outer, channels), (inner, inner, 1)]
            self.down.append(TileModule(layers, shapes, backend, threads))
        for scale, (finer, coarser) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            layers = FusionLayers(pyramid, scale, dtype) if scale else ContextLayers(pyramid, dtype)
            self.halo = np.int32(layers.halo)
            side = CONTEXT_TILE + 2 * layers.halo
            shapes = [(side, side, n) for n in (finer, coarser, 1)]
            if not scale:
                shapes += [(CONTEXT_TILE, CONTEXT_TILE, n) for n in (network.channels, 1)]
            self.fuse.append(TileModule(layers, shapes, backend, threads))

    def update(self, state: Any, update: ContextUpdate) -> None:
        """Bring scales, their sums and the context of `state` up to date in the cells of `update`."""
        corners = [tiles_numba.find_tiles(cells, CONTEXT_TILE) for cells in update.cells]
        finer = [state.hidden, *state.scales]
        for scale, module in enumerate(self.down):
            self._make_scale(module, finer[scale], corners[scale], update.cells[scale], state.scales[scale])
        for scale in reversed(range(len(self.fuse))):
            self._fuse(scale, state, corners[scale], update)

    def _make_scale(self, module, source, corners, cells, target) -> None:
        for part, size, given in module.batches(len(corners)):
            x, inside = given
            tiles_numba.gather(source, 2 * corners[part] - np.int32(2 * BLOCK_HALO + 1), x)
            tiles_numba.mark_inside(*target.shape[:2], corners[part] - np.int32(BLOCK_HALO), inside)
            tiles_numba.scatter(module.run(size, given), corners[part], cells, target)

    def _fuse(self, scale, state, corners, update) -> None:
        module, finer, coarser = self.fuse[scale], state.scales[scale], state.fused[scale + 1]
        spans = [interpolation_spans(n, m) for n, m in zip(coarser.shape[:2], finer.shape[:2], strict=True)]
        for part, size, given in module.batches(len(corners)):
            first = corners[part] - self.halo
            tiles_numba.gather(finer, first, given[0])
            tiles_numba.gather_interpolated(coarser, *spans, first, given[1])
            tiles_numba.mark_inside(*finer.shape[:2], first, given[2])
            if not scale:
                tiles_numba.gather(state.context, corners[part], given[3])
                tiles_numba.gather(update.recency[..., None], corners[part], given[4])
            target = state.fused[scale] if scale else state.context
            made = module.run(size, given)
            tiles_numba.scatter(made, corners[part], update.cells[scale], target)


@lru_cache(64)
def interpolation_spans(coarse: int, fine: int) -> Float[np.ndarray, "fine 3"]:
    """Return, for each place of a bilinear interpolation, two places to take and the weight of the
    second, as torch does without align_corners."""
    place = np.maximum((np.arange(fine) + 0.5) * np.float32(coarse / fine) - 0.5, 0)
    first = place.astype(int)
    second = np.minimum(first + 1, coarse - 1)
    return np.stack([first, second, place - first], 1).astype(np.float32)


def _zeros(size: tuple[int, int, int]) -> Float[np.ndarray, "h w c"]:
    channels, height, width = size
    return np.zeros((height, width, channels), np.float32)
