"""A SetNet over windows of events, computed on the tiles that change."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from src.deploy.engines import clock_numba, tiles_numba
from src.deploy.engines.clock_numba import QUARTER, TILE
from src.deploy.setnet_clock import (
    ContextUpdate,
    EventMaps,
    EventPixels,
    LeakySumState,
    SetNetClock,
    Tick,
)
from src.deploy.setnet_context import CONTEXT_TILE, ContextTiles, WholeContext, find_tiles
from src.deploy.setnet_layers import DecoderLayers, MemoryLayers, WholeDecoder, WholeWindow
from src.deploy.tile_batches import Backend, TileModule
from src.models.background import BACKGROUND, BACKGROUND_WEIGHT, REVEALING_EVENTS
from src.models.setnet import CELL_PX, SetNet
from src.sim.optics import Position

BATCHES = 8, 16, 32, 64, 128  # sizes of batches, in tiles
# Share of the frame in tiles from which on all of it is computed at once, which takes no longer.
WHOLE_MEMORY, WHOLE_CONTEXT, WHOLE_DECODER = 0.3, 0.25, 0.6


class TileState:
    """What lives from window to window, advanced in place: maps (rows, columns, channels), pixels
    and the frame (h, w)."""

    def __init__(self, network: SetNet, height: int, width: int):
        rows, columns, c = height // CELL_PX, width // CELL_PX, network.channels
        hidden, context = (c, rows, columns), (c, rows // 2, columns // 2)
        self.hidden, self.spare_hidden = _zeros(hidden), _zeros(hidden)
        self.smoothed, self.levels = _zeros(context), len(network.context.downs)
        held = network.context.held_map_sizes(rows, columns)
        self.set_context_maps(_zeros(context), *map(_zeros, held))
        self.revealed = np.zeros((rows, columns), np.float32)  # how far cells are, in [0, 1]
        self.light = np.zeros((height, width), np.float32)  # of pixels, times that
        self.totals = np.zeros(2)  # of weights and of light, of blend_background
        self.frame = np.full((height, width), BACKGROUND, np.float32)

    def write_pixels(self, pixels: np.ndarray, corners: np.ndarray, evidence: np.ndarray) -> None:
        """Write tiles of pixels into `light`; `add_background` writes `frame`."""
        shown = self.revealed, self.light, self.totals
        half = np.float32(REVEALING_EVENTS)
        tiles_numba.write_pixels(pixels, corners, evidence, half, *shown)

    def add_background(self) -> None:
        """Bring `frame` up to date, as models.background.blend_background does."""
        weight, light = self.totals
        light += BACKGROUND_WEIGHT * BACKGROUND
        background = np.float32(light / (weight + BACKGROUND_WEIGHT))
        tiles_numba.add_background(self.light, self.revealed, background, self.frame)

    def set_context_maps(self, context: np.ndarray, *held: np.ndarray) -> None:
        """Hold a context and maps in the order of ContextPyramid.held_map_sizes."""
        self.context, self.scales = context, list(held[: self.levels])
        # The sums with coarser scales, by scale; the coarsest has none, the finest is not held.
        self.fused: list[Any] = [None, *reversed(held[self.levels :]), held[self.levels - 1]]

    def pyramid_maps(self) -> list[np.ndarray]:
        """Return the maps in that order."""
        return self.scales + self.fused[-2:0:-1]


class SetNetTilesState(NamedTuple):
    """All that lives from window to window, advanced in place."""

    clock: SetNetClock
    sums: LeakySumState
    maps: TileState


class SetNetTiles:
    """Brings a SetNetTilesState forward, window by window; `padded`: (h, w) of a picture."""

    def __init__(
        self, network: SetNet, positions: Sequence[Position], padded: tuple[int, int],
        dtype: torch.dtype, backend: Backend, threads: int,
    ):  # fmt: skip
        self.network, self.padded, how = network, padded, (backend, threads)
        self.slot_of = np.zeros((len(positions), *padded), np.int32)
        memory, decoder = MemoryLayers(network, positions, dtype), DecoderLayers(network, dtype)
        self.events = EventMaps(network, positions, memory.mixture_code, padded, threads)
        mixtures = self.events.size[3]
        c, near, far = network.channels, TILE + 2, TILE + 4
        shapes = [(near, near, c), (far, far, mixtures), (near, near, 1), (TILE, TILE, c)]
        self.memory = TileModule(memory, shapes, *how, BATCHES)
        self.decoder = TileModule(decoder, [(far, far, c)], *how, BATCHES)
        self.context = ContextTiles(network, dtype, *how)
        self.whole = WholeFrame(network, positions, padded, dtype, *how)
        self.reset()

    def collect_events(self, t, x, y, p, view, t0: float, t1: float) -> EventPixels:
        """Return the pixels of a window's events; `t`, `t0` and `t1` in seconds."""
        places = np.empty((len(t), 3), np.int32)
        voxels = np.empty((len(t), self.network.bins), np.float32)
        count = clock_numba.collect_pixels(t, x, y, p, view, t0, t1, self.slot_of, places, voxels)
        return EventPixels(places[:count], voxels[:count], np.float32(t1 - t0))

    def reset(self) -> None:
        views, rows, columns, mixtures = self.events.size
        clock = SetNetClock(views, rows, columns, len(self.network.context.downs))
        sums = LeakySumState(views, rows, columns, mixtures)
        self.state = SetNetTilesState(clock, sums, TileState(self.network, *self.padded))

    def is_settled(self, state: SetNetTilesState | None) -> bool:
        return state is not None and state.clock.is_settled()

    def advance_without_events(self, state: SetNetTilesState, seconds: float) -> SetNetTilesState:
        state.clock.decay_traces(seconds)
        return state

    def __call__(self, pixels: EventPixels) -> Float[np.ndarray, "h w"]:
        """Return the frame, padded, valid until the next window."""
        clock, sums, maps = self.state
        tick = clock.tick(pixels)
        is_most = self._is_most(TILE, len(tick.active_tiles), WHOLE_MEMORY)
        if not tick.update:
            self._smooth(tick)
        if len(tick.active_tiles):
            self.events.add(pixels, clock, sums)
        if is_most:
            self.whole.advance_and_draw(self.events.voxel_map, sums.mixtures, clock.elapsed_s, maps)
        else:
            self._remember(tick.active_tiles)
        if tick.update:
            self._update_context(tick.update)
            self._smooth(tick)
        if is_most and not tick.update:
            self.whole.write_drawn_pixels(maps, clock.evidence)
        elif self._is_most(TILE, len(tick.changed_tiles), WHOLE_DECODER):
            self.whole.draw(maps, clock.evidence)
        else:
            self._draw(tick.changed_tiles)
        if is_most or len(tick.changed_tiles):
            maps.add_background()
        return maps.frame

    def _smooth(self, tick: Tick) -> None:
        maps, corners = self.state.maps, QUARTER * tick.smoothed_tiles
        cells = tick.smoothed_cells, tick.smoothing_kept
        tiles_numba.smooth(maps.context, corners, *cells, maps.smoothed)

    def _is_most(self, side_cells: int, tiles: int, share: float) -> bool:
        """Return whether `tiles` are more than a `share` of the frame."""
        _, rows, columns, _ = self.events.size
        return tiles * side_cells**2 > share * rows * columns

    def _update_context(self, update: ContextUpdate) -> None:
        tiles = len(find_tiles(update.cells[0]))
        if self._is_most(2 * CONTEXT_TILE, tiles, WHOLE_CONTEXT):
            self.whole.update_context(update, self.state.maps)
        else:
            self.context.update(self.state.maps, update)

    def _remember(self, tiles: np.ndarray) -> None:
        clock, sums, maps = self.state
        corners, elapsed_s, events = TILE * tiles, clock.elapsed_s[..., None], self.events
        near, far = np.int32(MemoryLayers.VOXEL_HALO), np.int32(MemoryLayers.MIXTURE_HALO)

        def read(part: slice, inputs: list[np.ndarray]) -> None:
            tiles_numba.gather(events.voxel_map, corners[part] - near, inputs[0])
            tiles_numba.gather(sums.mixtures, corners[part] - far, inputs[1])
            tiles_numba.gather(elapsed_s, corners[part] - near, inputs[2])
            tiles_numba.gather(maps.hidden, corners[part], inputs[3])

        def write(part: slice, after: np.ndarray) -> None:
            tiles_numba.scatter(after, corners[part], clock.elapsed_s, maps.hidden)

        self.memory.run(len(corners), read, write)

    def _draw(self, tiles: np.ndarray) -> None:
        state, halo = self.state.maps, np.int32(DecoderLayers.HALO)
        evidence = self.state.clock.evidence

        def read(part: slice, inputs: list[np.ndarray]) -> None:
            corners = TILE * tiles[part] - halo
            tiles_numba.gather_relu_sum(state.hidden, state.smoothed, corners, inputs[0])

        def write(part: slice, pixels: np.ndarray) -> None:
            corners = QUARTER * tiles[part]
            state.write_pixels(pixels, corners, evidence)

        self.decoder.run(len(tiles), read, write)


class WholeFrame:
    """What SetNetTiles do, on whole maps."""

    def __init__(
        self, network: SetNet, positions: Sequence[Position], padded: tuple[int, int],
        dtype: torch.dtype, backend: Backend, threads: int,
    ):  # fmt: skip
        c, (rows, columns) = network.channels, (side // CELL_PX for side in padded)
        near, far = (rows, columns), (rows // 2, columns // 2)
        held = [size[1:] + size[:1] for size in network.context.held_map_sizes(*near)]

        def compile_module(module: nn.Module, *shapes: tuple[int, ...]) -> Any:
            return backend(
                module, [torch.zeros(1, *shape, dtype=torch.float32) for shape in shapes], threads
            )

        window = WholeWindow(network, positions, dtype)
        given = [(*near, channels) for channels in (c, window.memory.kernel.shape[1], 1, c)]
        self.window = compile_module(window, *given, (*far, c))
        given = [(*near, c), (*far, c), (*far, 1), (*far, 1), *held]
        self.context = compile_module(WholeContext(network, dtype), *given)
        self.decoder = compile_module(WholeDecoder(network, dtype), (*near, c), (*far, c))
        self.spare = [np.zeros(shape, np.float32) for shape in [(*far, c), *held]]
        self.pixels = np.empty((1, *far, (2 * CELL_PX) ** 2), np.float32)

    def advance_and_draw(self, voxel_map, mixtures, elapsed_s, maps: TileState) -> None:
        """Advance the hidden map, and draw with the context as it is what `write_drawn_pixels`
        writes."""
        given = voxel_map, mixtures, elapsed_s[..., None], maps.hidden, maps.smoothed
        self.window.run([part[None] for part in given], [maps.spare_hidden[None], self.pixels])
        maps.hidden, maps.spare_hidden = maps.spare_hidden, maps.hidden

    def update_context(self, update: ContextUpdate, maps: TileState) -> None:
        """Bring the maps of the context up to date in the cells of `update`."""
        held = maps.pyramid_maps()
        is_updated = update.cells[0].astype(np.float32)[..., None]
        given = maps.hidden, maps.context, update.recency[..., None], is_updated, *held
        self.context.run([part[None] for part in given], [part[None] for part in self.spare])
        made, self.spare = self.spare, [maps.context, *held]
        maps.set_context_maps(*made)

    def draw(self, maps: TileState, evidence: np.ndarray) -> None:
        self.decoder.run([maps.hidden[None], maps.smoothed[None]], [self.pixels])
        self.write_drawn_pixels(maps, evidence)

    def write_drawn_pixels(self, maps: TileState, evidence: np.ndarray) -> None:
        """Write the pixels that were drawn last."""
        corner = np.zeros((1, 2), np.int32)
        maps.write_pixels(self.pixels, corner, evidence)


def _zeros(size: tuple[int, int, int]) -> Float[np.ndarray, "h w c"]:
    channels, height, width = size
    return np.zeros((height, width, channels), np.float32)
