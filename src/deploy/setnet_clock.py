"""SetNet's clock, event map and leaky sums, which advance where events fall: maps of cells."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from src.deploy.engines import clock_numba, sums_numba
from src.deploy.engines.clock_numba import QUARTER, TILE
from src.deploy.first_layer import event_patches, output_spans_of_inputs
from src.models import cell_clock
from src.models.background import REVEALING_EVENTS, REVEALING_S
from src.models.context_pyramid import CONTEXT_TAU_S
from src.models.setnet import CELL_PX, REFERENCE_HZ, SUM_TAUS_S, SetNet
from src.sim.optics import Position

SIDE_BY_SIDE = 2000  # pixels with events from which on two threads take less time
# Weights of REACH_CELLS averages of three cells, one after the other.
SMOOTHING = np.float32(reduce(np.convolve, [np.full(3, 1 / 3)] * cell_clock.REACH_CELLS))


class EventPixels(NamedTuple):
    """The pixels that had events in a window of `window_s`: view, row and column, and voxels."""

    places: Int[np.ndarray, "n 3"]
    voxels: Float[np.ndarray, "n bins"]
    window_s: np.float32


class ContextUpdate(NamedTuple):
    """Which cells of each scale of the context a window updates, and the age of their context."""

    cells: list[UInt8[np.ndarray, "_h _w"]]
    recency: Float[np.ndarray, "h4 w4"]


class Tick(NamedTuple):
    """What a window changes; tiles by (row, column) in the frame."""

    active_tiles: Int[np.ndarray, "n 2"]  # with cells whose clock advances
    update: ContextUpdate | None
    smoothed_tiles: Int[np.ndarray, "k 2"]  # in which the smoothed context advances
    smoothed_cells: UInt8[np.ndarray, "k q q"]
    smoothing_kept: np.float32  # of its distance from the context
    changed_tiles: Int[np.ndarray, "d 2"]  # whose pixels may change


class SetNetClock:
    """What lives from window to window, advanced in place: fields of SetNetState as (views, rows,
    columns) or (rows, columns), float32 or bytes, and which tiles have what; `scales`: of the
    context."""

    def __init__(self, views: int, rows: int, columns: int, scales: int):
        self.scales, tiles = scales, (-(-rows // TILE), -(-columns // TILE))
        self.trace = np.zeros((views, rows + 2, columns + 2), np.float32)  # a border of zeros
        self.activity = np.zeros((rows, columns), np.float32)
        self.evidence = np.zeros((rows, columns), np.float32)
        self.elapsed_s = np.zeros((rows, columns), np.float32)  # in the last window
        self.is_pending = np.zeros((rows, columns), np.uint8)
        self.recency = np.zeros((rows // 2, columns // 2), np.float32)
        self.update_recency = np.float32(0)
        self.active_tiles = np.zeros(tiles, np.uint8)
        self.pending_tiles = np.zeros(tiles, np.uint8)
        self.settling_tiles = np.zeros(tiles, np.uint8)
        # Between two windows all zero.
        self.counts = np.zeros((views, rows, columns), np.float32)
        self.supported = np.zeros((rows, columns), np.float32)
        self.is_near = np.zeros((rows, columns), np.uint8)
        self.near_tiles = np.zeros(tiles, np.uint8)

    def tick(self, pixels: EventPixels) -> Tick:
        """Bring the clock to the end of a window."""
        changed = np.zeros_like(self.near_tiles)
        longest_s = self._advance(pixels, changed)
        smoothed, update = self._advance_context(longest_s, changed)
        kept = exp_float32(-longest_s / np.float32(CONTEXT_TAU_S))
        tiles = (list_nonzero_cells(part) for part in (self.active_tiles, changed))
        active_tiles, changed_tiles = tiles
        return Tick(active_tiles, update, *smoothed, kept, changed_tiles)

    def is_settled(self) -> bool:
        """Return whether no cell advances until there are events."""
        return not (self.active_tiles.any() and self.activity.any())

    def decay_traces(self, seconds: float) -> None:
        """Bring a clock that `is_settled` forward by `seconds` without events."""
        if self.active_tiles.any():  # of the last window, in which some cells advanced
            self.active_tiles[:], self.elapsed_s[:] = 0, 0
        kept = exp_float32(np.float32(-seconds / cell_clock.TRACE_TAU_S))
        clock_numba.fade(kept, self.trace.reshape(-1))

    def _advance(self, pixels: EventPixels, changed: np.ndarray) -> np.float32:
        places, voxels, window_s = pixels
        kept, trace_kept = (
            exp_float32(-window_s / np.float32(tau))
            for tau in (cell_clock.ACTIVITY_TAU_S, cell_clock.TRACE_TAU_S)
        )
        events = places, voxels, trace_kept, np.float32(cell_clock.MIN_SUPPORT)
        spans = clock_numba.count_supported_events(*events, self.counts, self.trace, self.supported)
        near = self.is_near, self.near_tiles
        clock_numba.spread(self.supported, spans, SMOOTHING, self.evidence, *near)
        fading = kept, np.float32(cell_clock.ACTIVITY_TAU_S), np.float32(cell_clock.MIN_ACTIVITY)
        tiles = self.is_near, self.near_tiles, self.active_tiles
        cells = self.activity, self.elapsed_s, self.is_pending
        longest_s, active = clock_numba.advance_clocks(
            window_s, *fading, *tiles, *cells, self.pending_tiles, changed
        )
        share = np.float32(active) / np.float32(self.activity.size)
        static, moving = cell_clock.STATIC_SHARE, cell_clock.MOVING_SHARE
        pace = (share - np.float32(static)) / np.float32(moving - static)
        if pace <= 0:
            return np.float32(longest_s)
        moving_s = min(pace, np.float32(1)) * np.float32(longest_s)
        np.maximum(self.elapsed_s, moving_s, out=self.elapsed_s)
        self.evidence += np.float32(REVEALING_EVENTS / REVEALING_S) * moving_s
        for part in (self.is_pending, self.active_tiles, self.pending_tiles, changed):
            part[:] = 1
        return np.float32(longest_s)

    def _advance_context(
        self, longest_s: np.float32, changed: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], ContextUpdate | None]:
        if longest_s == 0:
            none = np.zeros((0, QUARTER, QUARTER), np.uint8)
            return (np.zeros((0, 2), np.int32), none), None
        kept = exp_float32(-longest_s / np.float32(cell_clock.CONTEXT_INTERVAL_S))
        self.update_recency *= kept
        clock_numba.fade(kept, self.recency.reshape(-1))
        tiles = self.pending_tiles, self.settling_tiles
        given = self.recency, np.float32(cell_clock.SETTLING), self.is_pending
        smoothed = clock_numba.find_cells_to_smooth(*given, *tiles, changed)
        is_due = self.update_recency <= np.float32(cell_clock.UPDATE_RECENCY)
        return smoothed, self._start_update() if is_due else None

    def _start_update(self) -> ContextUpdate:
        cells = [max_of_squares(self.is_pending, 2)]
        for _ in range(self.scales - 1):
            cells.append(max_of_squares(cells[-1], 2))
        update = ContextUpdate(cells, self.recency.copy())
        self.recency[cells[0] > 0] = 1
        self.settling_tiles |= max_of_squares(cells[0], QUARTER)
        self.is_pending[:], self.pending_tiles[:] = 0, 0
        self.update_recency = np.float32(1)
        return update


class LeakySumState:
    """What lives from window to window, advanced in place: the leaky sums and their mixtures."""

    def __init__(self, views: int, rows: int, columns: int, mixtures: int):
        self.sums = np.zeros((rows, views, len(SUM_TAUS_S), columns), np.float32)
        self.mixtures = np.zeros((rows, columns, mixtures), np.float32)


class EventMaps:
    """Makes the map of SetNet's voxel kernels and advances a LeakySumState, in active tiles; with
    two `threads` side by side.  `padded`: (h, w) of a picture, multiples of 8."""

    def __init__(
        self, network: SetNet, positions: Sequence[Position], mixture_code: np.ndarray,
        padded: tuple[int, int], threads: int,
    ):  # fmt: skip
        self.pool = ThreadPoolExecutor(1) if threads > 1 else None
        kernel, _, bias = network.stem_kernels_and_bias(tuple(positions))
        kernels, views = kernel.numpy(), len(positions)
        self.bias_row = np.tile(bias.numpy(), TILE)
        self.patches = event_patches(kernels, views, CELL_PX)
        self.spans = [output_spans_of_inputs(side, CELL_PX, kernels.shape[-1]) for side in padded]
        self.code = np.repeat(mixture_code, len(SUM_TAUS_S), 1)
        self.taus_s = np.array(SUM_TAUS_S, np.float32)
        rows, columns = (side // CELL_PX for side in padded)
        self.size = views, rows, columns, self.code.shape[1] + len(SUM_TAUS_S)
        # What lies outside of active tiles is used nowhere.
        self.voxel_map = np.zeros((rows, columns, len(bias)), np.float32)
        self.cell_sums = np.zeros((rows, views, columns), np.float32)  # zero between two windows

    def add(self, pixels: EventPixels, clock: SetNetClock, state: LeakySumState) -> None:
        """Bring `state` to the end of a window, and make its `voxel_map`."""
        work, is_much = (pixels, clock, state), len(pixels.places) > SIDE_BY_SIDE
        sums = self.pool.submit(self._advance_sums, *work) if self.pool and is_much else None
        self._make_voxel_map(pixels, clock)
        sums.result() if sums else self._advance_sums(*work)

    def _make_voxel_map(self, pixels: EventPixels, clock: SetNetClock) -> None:
        places, voxels, window_s = pixels
        # As SetNet counts them.
        rate_scale = np.float32(1 / (REFERENCE_HZ * float(window_s)))
        sums_numba.fill_tiles(clock.active_tiles, self.bias_row, self.voxel_map)
        patch = clock.elapsed_s, *self.spans, self.patches, self.voxel_map
        sums_numba.add_patches(places, voxels, rate_scale, *patch)

    def _advance_sums(self, pixels: EventPixels, clock: SetNetClock, state: LeakySumState) -> None:
        places, voxels, _ = pixels
        pixel_sums = np.empty(len(places), np.float32)
        sums_numba.add_to_cells(places, voxels, clock.elapsed_s, self.cell_sums, pixel_sums)
        passed = clock.active_tiles, clock.elapsed_s, self.taus_s
        sums_numba.leak(*passed, self.cell_sums, state.sums, state.mixtures)
        sums_numba.add_to_mixtures(places, pixel_sums, self.code, state.mixtures)


def list_nonzero_cells(mask: np.ndarray) -> Int[np.ndarray, "n 2"]:
    """Return (row, column) of what is not 0, in rows: numba compiles for one layout."""
    return np.ascontiguousarray(np.argwhere(mask), np.int32)


def max_of_squares(mask: np.ndarray, side: int) -> np.ndarray:
    """Return the largest value of each square of `side` cells; at an end of what there is."""
    for axis in (0, 1):
        mask = np.maximum.reduceat(mask, np.arange(0, mask.shape[axis], side), axis)
    return mask


@lru_cache(4096)
def exp_float32(x: np.float32) -> np.float32:
    """Return exp(x) to the last bit as torch gives it."""
    return np.float32(torch.exp(torch.tensor([x], dtype=torch.float32)).item())
