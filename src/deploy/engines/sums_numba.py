"""SetNet's event map and leaky sums, advanced in active tiles only (numba).

`places` (n, 3) and `grid` (n, bins): the pixels that had events and their voxels, of
`clock_numba.collect_pixels`; those of cells that stand still are left out.
"""

import numpy as np
from numba import njit

from src.deploy.engines.clock_numba import SIDE, TILE

f32 = np.float32


@njit(nogil=True, cache=True)
def fill_tiles(active_tiles, values, out):
    """Write `values` (TILE * channels,), those of a row, into active tiles of `out` (rows,
    columns, channels)."""
    flat = out.reshape(-1)
    for i, j in np.ndindex(active_tiles.shape):
        if active_tiles[i, j]:
            n = np.uint64(min(TILE, out.shape[1] - j * TILE) * out.shape[2])
            for r in range(i * TILE, min((i + 1) * TILE, len(out))):
                at = np.uint64((r * out.shape[1] + j * TILE) * out.shape[2])
                for k in range(n):
                    flat[at + k] = values[k]


@njit(nogil=True, cache=True)
def add_patches(places, grid, rate_scale, elapsed_s, row_spans, column_spans, patches, out):
    """Add the patches of all pixels, times `rate_scale`, to `out` (rows, columns, channels).

    `patches`, `row_spans`, `column_spans`: of `src.deploy.first_layer`.
    """
    bins, reach, wide = patches.shape[1], patches.shape[4], patches.shape[5]
    channels, pitch = wide // reach, out.shape[1] * out.shape[2]
    flat, to = patches.reshape(-1), out.reshape(-1)
    phase = reach * wide
    each = SIDE * SIDE * phase
    for i in range(len(places)):
        v, y, x = places[i]
        if elapsed_s[y // SIDE, x // SIDE] == 0:
            continue
        row, column = row_spans[y], column_spans[x]
        start = v * bins * each + ((y % SIDE) * SIDE + x % SIDE) * phase
        start += row[1] * wide + column[1] * channels
        corner = row[0] * pitch + column[0] * channels
        n, b = np.uint64(column[2] * channels), 0
        while b < bins:
            early = rate_scale * grid[i, b]
            if early == 0:
                b += 1
                continue
            more = b + 1 < bins
            late = rate_scale * grid[i, b + 1] if more else f32(0)
            k, after, o = start + b * each, each if more else 0, corner
            for _ in range(row[2]):
                here, one, two = np.uint64(o), np.uint64(k), np.uint64(k + after)
                for q in range(n):
                    to[here + q] += early * flat[one + q] + late * flat[two + q]
                o += pitch
                k += wide
            b += 2


@njit(nogil=True, cache=True)
def add_to_cells(places, grid, elapsed_s, cell_sums, pixel_sums):
    """Add what the pixels sum to, to `cell_sums` (rows, views, columns) and write it into
    `pixel_sums` (n,), 0 where the cell stands still."""
    for i in range(len(places)):
        v, r, c = places[i, 0], places[i, 1] // SIDE, places[i, 2] // SIDE
        total = f32(0)
        if elapsed_s[r, c] > 0:
            for b in range(grid.shape[1]):
                total += grid[i, b]
            cell_sums[r, v, c] += total
        pixel_sums[i] = total


@njit(nogil=True, cache=True)
def leak(active_tiles, elapsed_s, taus_s, cell_sums, sums, mixed):
    """Advance `sums` (rows, views, taus, columns) by `elapsed_s` in active tiles and add
    `cell_sums` (rows, views, columns), which are cleared; let `mixed` (rows, columns, mixtures)
    leak, and write the spread of the views behind its mixtures.
    """
    columns = elapsed_s.shape[1]
    decay = np.empty((taus_s.size, columns), f32)
    middle, far = np.empty(columns, f32), np.empty(columns, f32)
    for i in range(len(active_tiles)):
        j = 0
        while j < active_tiles.shape[1]:
            if not active_tiles[i, j]:
                j += 1
                continue
            first = j * TILE
            while j < active_tiles.shape[1] and active_tiles[i, j]:
                j += 1
            last = min(j * TILE, columns)
            for r in range(i * TILE, min((i + 1) * TILE, len(elapsed_s))):
                _write_decays(elapsed_s[r, first:last], taus_s, decay)
                _leak_row(first, last, decay, cell_sums[r], sums[r], mixed[r], middle, far)


@njit(nogil=True, cache=True)
def _write_decays(elapsed_s, taus_s, decay):
    before, value = f32(-1), np.ones(taus_s.size, f32)
    for c in range(elapsed_s.size):
        if elapsed_s[c] != before:
            before = elapsed_s[c]
            for m in range(taus_s.size):
                value[m] = np.exp(-before / taus_s[m])
        for m in range(taus_s.size):
            decay[m, c] = value[m]


@njit(nogil=True, cache=True)
def _leak_row(first, last, decay, new, sums, mixed, middle, far):
    views, taus, n = sums.shape[0], sums.shape[1], np.uint64(last - first)
    part, behind = f32(1) / f32(views), mixed.shape[1] - taus
    for m in range(taus):
        factor = decay[m]
        for c in range(n):
            middle[c] = far[c] = 0
        for v in range(views):
            row, more = sums[v, m, first:last], new[v, first:last]
            for c in range(n):
                row[c] = row[c] * factor[c] + more[c]
                middle[c] += row[c] * part
        for v in range(views if views > 1 else 0):
            row = sums[v, m, first:last]
            for c in range(n):
                far[c] += abs(row[c] - middle[c]) * part
        for c in range(n):
            mixed[first + c, behind + m] = far[c]
    for v in range(views):
        new[v, first:last] = 0
    mixtures, to, each = np.uint64(behind), mixed.reshape(-1), np.empty(behind, f32)
    for c in range(n):
        if c == 0 or decay[0, c] != decay[0, c - np.uint64(1)]:
            for k in range(mixtures):
                each[k] = decay[k % np.uint64(taus), c]
        at = (np.uint64(first) + c) * np.uint64(mixed.shape[1])
        for k in range(mixtures):
            to[at + k] *= each[k]


@njit(nogil=True, cache=True)
def add_to_mixtures(places, pixel_sums, code, mixed):
    """Add the `pixel_sums` to the mixtures of their cells, `code` (views, mixtures)."""
    n, to, shares = np.uint64(code.shape[1]), mixed.reshape(-1), code.reshape(-1)
    for i in range(len(places)):
        total = pixel_sums[i]
        if total != 0:
            r, c = places[i, 1] // SIDE, places[i, 2] // SIDE
            here = np.uint64((r * mixed.shape[1] + c) * mixed.shape[2])
            there = np.uint64(places[i, 0]) * n
            for k in range(n):
                to[here + k] += total * shares[there + k]
