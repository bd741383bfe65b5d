"""SetNet's clock, event map and leaky sums, which advance where events fall: maps of cells."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache, reduce
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from src.deploy.engines import clock_numba as clock
from src.deploy.engines import sums_numba
from src.deploy.engines.clock_numba import QUARTER, TILE
from src.deploy.first_layer import event_patches, patch_spans
from src.models.setnet import (
    ACTIVITY_TAU_S,
    CELL_PX,
    CONTEXT_INTERVAL_S,
    CONTEXT_TAU_S,
    MIN_ACTIVITY,
    MIN_SUPPORT,
    MOVING_SHARE,
    REACH_CELLS,
    REFERENCE_HZ,
    REVEALING_EVENTS,
    REVEALING_S,
    SETTLING,
    STATIC_SHARE,
    SUM_TAUS_S,
    TRACE_TAU_S,
    UPDATE_RECENCY,
    SetNet,
)
from src.sim.optics import Position

SIDE_BY_SIDE = 2000  # pixels with events from which on two threads take less time
# Weights of REACH_CELLS averages of three cells, one after the other.
SMOOTHING = np.float32(reduce(np.convolve, [np.full(3, 1 / 3)] * REACH_CELLS))


class EventPixels(NamedTuple):
    """The pixels that had events in a window of `window_s`: view, row and column, and voxels."""

    places: Int[np.ndarray, "n 3"]
    voxels: Float[np.ndarray, "n bins"]
    window_s: np.float32


class SetNetEvents:
    """From events to the pixels that had any; nothing lives from window to window."""

    state = None

    def __init__(self, views: int, padded: tuple[int, int], bins: int):
        self.bins, self.slot_of = bins, np.zeros((views, *padded), np.int32)

    def add(self, t, x, y, p, view, t0: float, t1: float) -> EventPixels:
        """Return the pixels of a window's events."""
        places, voxels = np.empty((len(t), 3), np.int32), np.empty((len(t), self.bins), np.float32)
        count = clock.collect_pixels(t, x, y, p, view, t0, t1, self.slot_of, places, voxels)
        return EventPixels(places[:count], voxels[:count], np.float32(t1 - t0))

    def reset(self) -> None:
        """Do nothing: there is nothing to forget."""


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


class ClockState:
    """What lives from window to window, advanced in place: fields of SetNetState as (views, rows,
    columns) or (rows, columns), float32 or bytes, and which tiles have what."""

    def __init__(self, views: int, rows: int, columns: int):
        tiles = -(-rows // TILE), -(-columns // TILE)
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


class SetNetClock:
    """Advances a ClockState; `scales`: of the context."""

    def __init__(self, views: int, rows: int, columns: int, scales: int):
        self.scales = scales
        # Between two windows all zero.
        self.counts = np.zeros((views, rows, columns), np.float32)
        self.supported = np.zeros((rows, columns), np.float32)
        self.is_near = np.zeros((rows, columns), np.uint8)
        self.near_tiles = np.zeros((-(-rows // TILE), -(-columns // TILE)), np.uint8)

    def tick(self, pixels: EventPixels, now: ClockState) -> Tick:
        """Bring `now` to the end of a window."""
        changed = np.zeros_like(self.near_tiles)
        longest_s = self._advance(pixels, now, changed)
        smoothed, update = self._advance_context(longest_s, now, changed)
        kept = exp_float32(-longest_s / np.float32(CONTEXT_TAU_S))
        tiles = (np.argwhere(part).astype(np.int32) for part in (now.active_tiles, changed))
        active_tiles, changed_tiles = tiles
        return Tick(active_tiles, update, *smoothed, kept, changed_tiles)

    def _advance(self, pixels: EventPixels, now: ClockState, changed: np.ndarray) -> np.float32:
        places, voxels, window_s = pixels
        kept, trace_kept = (
            exp_float32(-window_s / np.float32(tau)) for tau in (ACTIVITY_TAU_S, TRACE_TAU_S)
        )
        events = places, voxels, trace_kept, np.float32(MIN_SUPPORT)
        spans = clock.find_supported(*events, self.counts, now.trace, self.supported)
        near = self.is_near, self.near_tiles
        clock.spread(self.supported, spans, SMOOTHING, now.evidence, *near)
        fading = kept, np.float32(ACTIVITY_TAU_S), np.float32(MIN_ACTIVITY)
        tiles = self.is_near, self.near_tiles, now.active_tiles
        cells = now.activity, now.elapsed_s, now.is_pending
        longest_s, active = clock.advance(
            window_s, *fading, *tiles, *cells, now.pending_tiles, changed
        )
        share = np.float32(active) / np.float32(now.activity.size)
        pace = (share - np.float32(STATIC_SHARE)) / np.float32(MOVING_SHARE - STATIC_SHARE)
        if pace <= 0:
            return np.float32(longest_s)
        moving_s = min(pace, np.float32(1)) * np.float32(longest_s)
        gained = np.float32(REVEALING_EVENTS / REVEALING_S)
        clock.advance_all(moving_s, gained, now.elapsed_s, now.evidence, now.is_pending)
        for part in (now.active_tiles, now.pending_tiles, changed):
            part[:] = 1
        return np.float32(longest_s)

    def _advance_context(
        self, longest_s: np.float32, now: ClockState, changed: np.ndarray
    ) -> tuple[tuple[np.ndarray, np.ndarray], ContextUpdate | None]:
        if longest_s == 0:
            none = np.zeros((0, QUARTER, QUARTER), np.uint8)
            return (np.zeros((0, 2), np.int32), none), None
        kept = exp_float32(-longest_s / np.float32(CONTEXT_INTERVAL_S))
        now.update_recency *= kept
        clock.fade(kept, now.recency.reshape(-1))
        tiles = now.pending_tiles, now.settling_tiles
        given = now.recency, np.float32(SETTLING), now.is_pending
        smoothed = clock.find_smoothed(*given, *tiles, changed)
        is_due = now.update_recency <= np.float32(UPDATE_RECENCY)
        return smoothed, self._start_update(now) if is_due else None

    def _start_update(self, now: ClockState) -> ContextUpdate:
        cells = [clock.halve(now.is_pending)]
        for _ in range(self.scales - 1):
            cells.append(clock.halve(cells[-1]))
        update = ContextUpdate(cells, now.recency.copy())
        clock.note_update(cells[0], now.recency, now.settling_tiles)
        now.is_pending[:], now.pending_tiles[:] = 0, 0
        now.update_recency = np.float32(1)
        return update


class SumState:
    """What lives from window to window, advanced in place: the leaky sums and their mixtures."""

    def __init__(self, views: int, rows: int, columns: int, mixtures: int):
        self.sums = np.zeros((rows, views, len(SUM_TAUS_S), columns), np.float32)
        self.mixtures = np.zeros((rows, columns, mixtures), np.float32)


class EventMaps:
    """Makes the map of SetNet's voxel kernels and advances a SumState, in active tiles; with two
    `threads` side by side.  `padded`: (h, w) of a picture, multiples of 8."""

    def __init__(
        self, network: SetNet, positions: Sequence[Position], mixture_code: np.ndarray,
        padded: tuple[int, int], threads: int,
    ):  # fmt: skip
        self.pool = ThreadPoolExecutor(1) if threads > 1 else None
        kernel, _, bias = network.stem_kernels_and_bias(tuple(positions))
        kernels, views = kernel.numpy(), len(positions)
        self.bias_row = np.tile(bias.numpy(), TILE)
        self.patches = event_patches(kernels, views, CELL_PX)
        self.spans = [patch_spans(side, CELL_PX, kernels.shape[-1]) for side in padded]
        self.code = np.repeat(mixture_code, len(SUM_TAUS_S), 1)
        self.taus_s = np.array(SUM_TAUS_S, np.float32)
        rows, columns = (side // CELL_PX for side in padded)
        self.size = views, rows, columns, self.code.shape[1] + len(SUM_TAUS_S)
        # What lies outside of active tiles is used nowhere.
        self.voxel_map = np.zeros((rows, columns, len(bias)), np.float32)
        self.new = np.zeros((rows, views, columns), np.float32)  # zero between two windows

    def add(self, pixels: EventPixels, clocks: ClockState, state: SumState) -> None:
        """Bring `state` to the end of a window, and make its `voxel_map`."""
        work, is_much = (pixels, clocks, state), len(pixels.places) > SIDE_BY_SIDE
        sums = self.pool.submit(self._advance_sums, *work) if self.pool and is_much else None
        self._make_voxel_map(pixels, clocks)
        sums.result() if sums else self._advance_sums(*work)

    def _make_voxel_map(self, pixels: EventPixels, clocks: ClockState) -> None:
        places, voxels, window_s = pixels
        weight = np.float32(1 / (REFERENCE_HZ * float(window_s)))  # as SetNet counts them
        sums_numba.fill_tiles(clocks.active_tiles, self.bias_row, self.voxel_map)
        patch = clocks.elapsed_s, *self.spans, self.patches, self.voxel_map
        sums_numba.add_patches(places, voxels, weight, *patch)

    def _advance_sums(self, pixels: EventPixels, clocks: ClockState, state: SumState) -> None:
        places, voxels, _ = pixels
        totals = np.empty(len(places), np.float32)
        sums_numba.add_to_cells(places, voxels, clocks.elapsed_s, self.new, totals)
        passed = clocks.active_tiles, clocks.elapsed_s, self.taus_s
        sums_numba.leak(*passed, self.new, state.sums, state.mixtures)
        sums_numba.add_to_mixtures(places, totals, self.code, state.mixtures)


@lru_cache(4096)
def exp_float32(x: np.float32) -> np.float32:
    """Return exp(x) to the last bit as torch gives it."""
    return np.float32(torch.exp(torch.tensor([x], dtype=torch.float32)).item())
