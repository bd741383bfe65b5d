"""The first half of a SetNet's window: from events to tiles of its event map and leaky sums.

Everything in here lives in maps of cells, which change only where the clock of a cell advances.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from src.deploy.engines import clock_numba as clock
from src.deploy.engines import sums_numba, tiles_numba
from src.deploy.engines.clock_numba import QUARTER, TILE
from src.deploy.first_layer import event_patches, patch_spans
from src.deploy.setnet_layers import MemoryLayers
from src.deploy.tile_batches import padded_count
from src.models.setnet import (
    ACTIVITY_TAU_S,
    CELL_PX,
    CONTEXT_INTERVAL_S,
    CONTEXT_TAU_S,
    REFERENCE_HZ,
    SUM_TAUS_S,
    UPDATE_RECENCY,
    SetNet,
)
from src.sim.optics import Position


class ContextUpdate(NamedTuple):
    """Which cells of each scale of the context a window updates, and the age of their context."""

    cells: list[UInt8[np.ndarray, "_h _w"]]
    recency: Float[np.ndarray, "h4 w4"]


class BegunWindow(NamedTuple):
    """What the layers behind the events need of a window; tiles by (row, column) in the frame."""

    tiles: Int[np.ndarray, "n 2"]  # with cells whose clock advances, and of them, padded batches:
    voxel_map: Float[np.ndarray, "b h1 w1 c"]
    mixtures: Float[np.ndarray, "b h2 w2 m"]
    elapsed_s: Float[np.ndarray, "b h1 w1 1"]
    update: ContextUpdate | None
    smoothed_tiles: Int[np.ndarray, "k 2"]  # in which the smoothed context advances
    smoothed_cells: UInt8[np.ndarray, "k q q"]
    smoothing_kept: np.float32  # of its distance from the context
    changed_tiles: Int[np.ndarray, "d 2"]  # whose pixels may change


class ClockState:
    """What lives from window to window, advanced in place: fields of SetNetState as (views, rows,
    columns) or (rows, columns), float32 or bytes, and which tiles have what."""

    def __init__(self, views: int, rows: int, columns: int, mixtures: int):
        tiles = -(-rows // TILE), -(-columns // TILE)
        self.sums = np.zeros((views, len(SUM_TAUS_S), rows, columns), np.float32)
        self.mixtures = np.zeros((rows, columns, mixtures), np.float32)
        self.trace = np.zeros((views, rows, columns), np.float32)
        self.activity = np.zeros((rows, columns), np.float32)
        self.elapsed_s = np.zeros((rows, columns), np.float32)
        self.is_pending = np.zeros((rows, columns), np.uint8)
        self.recency = np.zeros((rows // 2, columns // 2), np.float32)
        self.update_recency = np.float32(0)
        self.active_tiles = np.zeros(tiles, np.uint8)
        self.pending_tiles = np.zeros(tiles, np.uint8)
        self.settling_tiles = np.zeros(tiles, np.uint8)


class SetNetClock:
    """Brings a ClockState forward, window by window; with two `threads` the event map and the sums
    are made side by side.  `padded`: (h, w) of a picture, multiples of 8."""

    def __init__(
        self, network: SetNet, positions: Sequence[Position], mixture_code: np.ndarray,
        padded: tuple[int, int], threads: int,
    ):  # fmt: skip
        kernel, _, bias = network.stem_kernels(tuple(positions))
        self.bias, kernels, views = bias.numpy(), kernel.numpy(), len(positions)
        self.patches = event_patches(kernels, views, CELL_PX)
        self.spans = [patch_spans(side, CELL_PX, kernels.shape[-1]) for side in padded]
        self.code = np.repeat(mixture_code, len(SUM_TAUS_S), 1)
        self.scales = len(network.context.downs)
        self.taus_s = np.array(SUM_TAUS_S, np.float32)
        rows, columns = (side // CELL_PX for side in padded)
        self.size = views, rows, columns, self.code.shape[1] + len(SUM_TAUS_S)
        self.pool = ThreadPoolExecutor(1) if threads > 1 else None
        # Between two windows all zero, but for the event map, which is filled where it is used.
        self.slot_of = np.zeros((views, *padded), np.int32)
        self.counts, self.new = (np.zeros((views, rows, columns), np.float32) for _ in range(2))
        self.is_supported, self.is_near = (np.zeros((rows, columns), np.uint8) for _ in range(2))
        self.voxel_map = np.zeros((rows, columns, len(self.bias)), np.float32)
        self.reset()
        self.near_tiles = np.zeros_like(self.state.active_tiles)
        self.grid = np.empty((0, network.bins), np.float32)

    def reset(self) -> None:
        self.state = ClockState(*self.size)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> BegunWindow:
        """Bring the state to the end of a window; return what the layers behind need of it."""
        places, grid = self._collect(t, x, y, p, view, t0, t1)
        changed = np.zeros_like(self.near_tiles)
        longest_s = self._advance(places, grid, np.float32(t1 - t0), changed)
        smoothed, update = self._advance_context(longest_s, changed)
        kept = exp_float32(-longest_s / np.float32(CONTEXT_TAU_S))
        tiles = np.argwhere(self.state.active_tiles).astype(np.int32)
        weight = np.float32(1 / (REFERENCE_HZ * (t1 - t0)))  # as SetNet counts them
        if self.pool:
            made = self.pool.submit(self._make_mixtures, places, grid, tiles)
            voxel_map = self._make_voxel_map(places, grid, weight, tiles)
            mixtures = made.result()
        else:
            mixtures = self._make_mixtures(places, grid, tiles)
            voxel_map = self._make_voxel_map(places, grid, weight, tiles)
        elapsed_s = self._cut(self.state.elapsed_s[..., None], tiles, MemoryLayers.VOXEL_HALO)
        changed_tiles = np.argwhere(changed).astype(np.int32)
        inputs = tiles, voxel_map, mixtures, elapsed_s
        return BegunWindow(*inputs, update, *smoothed, kept, changed_tiles)

    def _collect(self, t, x, y, p, view, t0, t1) -> tuple[np.ndarray, np.ndarray]:
        if len(self.grid) < len(t):
            self.grid = np.empty((2 * len(t), self.grid.shape[1]), np.float32)
            self.places = np.empty((2 * len(t), 3), np.int32)
        if not len(t):
            return np.empty((0, 3), np.int32), self.grid[:0]
        count = clock.collect_pixels(
            t, x, y, p, view, t0, t1, self.slot_of, self.places, self.grid
        )
        return self.places[:count], self.grid[:count]

    def _advance(self, places, grid, window_s: np.float32, changed: np.ndarray) -> np.float32:
        now, kept = self.state, exp_float32(-window_s / np.float32(ACTIVITY_TAU_S))
        seen = self.counts, now.trace, self.is_supported, self.near_tiles
        clock.mark_supported(places, grid, kept, *seen)
        clock.widen(self.is_supported, self.is_near)
        tiles = self.is_near, self.near_tiles, now.active_tiles
        cells = now.activity, now.elapsed_s, now.is_pending
        return np.float32(
            clock.advance(window_s, kept, *tiles, *cells, now.pending_tiles, changed)
        )

    def _advance_context(
        self, longest_s: np.float32, changed: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], ContextUpdate | None]:
        now = self.state
        if longest_s == 0:
            none = np.zeros((0, QUARTER, QUARTER), np.uint8)
            return (np.zeros((0, 2), np.int32), none), None
        kept = exp_float32(-longest_s / np.float32(CONTEXT_INTERVAL_S))
        now.update_recency *= kept
        clock.fade(kept, now.recency.reshape(-1))
        tiles = now.pending_tiles, now.settling_tiles
        smoothed = clock.find_smoothed(now.recency, now.is_pending, *tiles, changed)
        update = None
        if now.update_recency <= np.float32(UPDATE_RECENCY):
            cells = [clock.halve(now.is_pending)]
            for _ in range(self.scales - 1):
                cells.append(clock.halve(cells[-1]))
            update = ContextUpdate(cells, now.recency.copy())
            clock.note_update(cells[0], now.recency, now.settling_tiles)
            now.is_pending[:], now.pending_tiles[:] = 0, 0
            now.update_recency = np.float32(1)
        return smoothed, update

    def _make_voxel_map(self, places, grid, weight, tiles) -> np.ndarray:
        sums_numba.fill_tiles(self.state.active_tiles, self.bias, self.voxel_map)
        patch = self.state.elapsed_s, *self.spans, self.patches, self.voxel_map
        sums_numba.add_patches(places, grid, weight, *patch)
        return self._cut(self.voxel_map, tiles, MemoryLayers.VOXEL_HALO)

    def _make_mixtures(self, places, grid, tiles) -> np.ndarray:
        now, totals = self.state, np.empty(len(places), np.float32)
        sums_numba.add_to_cells(places, grid, now.elapsed_s, self.new, totals)
        passed = now.active_tiles, now.elapsed_s, self.taus_s
        sums_numba.leak(*passed, self.new, now.sums, now.mixtures)
        sums_numba.add_to_mixtures(places, totals, self.code, now.mixtures)
        return self._cut(now.mixtures, tiles, MemoryLayers.MIXTURE_HALO)

    def _cut(self, source: np.ndarray, tiles: np.ndarray, halo: int) -> np.ndarray:
        side = TILE + 2 * halo
        out = np.empty((padded_count(len(tiles)), side, side, source.shape[2]), np.float32)
        out[len(tiles) :] = 0
        tiles_numba.gather(source, TILE * tiles - np.int32(halo), out)
        return out


@lru_cache(4096)
def exp_float32(x: np.float32) -> np.float32:
    """Return exp(x) to the last bit as torch gives it."""
    return np.float32(torch.exp(torch.tensor([x], dtype=torch.float32)).item())
