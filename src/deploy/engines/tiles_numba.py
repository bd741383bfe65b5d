"""Tiles cut from maps and written back (numba).

Maps are (rows, columns, channels), tiles (n, side, side, channels); `corners` (n, 2): the first row
and column of each tile in the map, its halo included, which may lie outside.
"""

import numpy as np
from numba import njit

from src.models.setnet import CELL_PX as CELL

f32 = np.float32


@njit(nogil=True, cache=True)
def gather(source, corners, out):
    """Write the tiles of `source` at `corners` into `out`; zeros outside the map."""
    rows, columns, channels = source.shape
    side, flat, to = out.shape[1], source.reshape(-1), out.reshape(-1)
    for i in range(len(corners)):
        first = corners[i, 1]
        begin = np.uint64(min(max(-first, 0), side) * channels)
        end = np.uint64(max(min(side, columns - first), 0) * channels)
        for k in range(side):
            row, at = corners[i, 0] + k, np.uint64((i * side + k) * side * channels)
            if not 0 <= row < rows:
                for q in range(np.uint64(side * channels)):
                    to[at + q] = 0
                continue
            shift = (row * columns + first) * channels
            for q in range(begin):
                to[at + q] = 0
            origin = np.uint64(shift + np.int64(begin))
            for q in range(end - begin):
                to[at + begin + q] = flat[origin + q]
            for q in range(end, np.uint64(side * channels)):
                to[at + q] = 0


@njit(nogil=True, cache=True)
def gather_relu_sum(near, far, corners, out):
    """Write the tiles of relu(near + far) into `out`, `far` of half the size; borders go on."""
    rows, columns, channels = near.shape
    side, a, b, to = out.shape[1], near.reshape(-1), far.reshape(-1), out.reshape(-1)
    at, n, zero = np.uint64(0), np.uint64(channels), f32(0)
    for i in range(len(corners)):
        for k in range(side):
            row = min(max(corners[i, 0] + k, 0), rows - 1)
            near_row, far_row = row * columns, row // 2 * (columns // 2)
            for q in range(side):
                column = min(max(corners[i, 1] + q, 0), columns - 1)
                one = np.uint64((near_row + column) * channels)
                two = np.uint64((far_row + column // 2) * channels)
                for c in range(n):
                    to[at + c] = max(a[one + c] + b[two + c], zero)
                at += n


@njit(nogil=True, cache=True)
def gather_interpolated(source, row_spans, column_spans, corners, out):
    """Write the tiles of relu(source), interpolated bilinearly to a finer map, into `out`; zeros
    outside.  Spans (side, 3): for each place of the finer map two of `source` and the weight of the
    second.
    """
    side, channels = out.shape[1], np.uint64(source.shape[2])
    zero = f32(0)
    for i in range(len(corners)):
        for k in range(side):
            row = corners[i, 0] + k
            for q in range(side):
                column, to = corners[i, 1] + q, out[i, k, q]
                if not (0 <= row < len(row_spans) and 0 <= column < len(column_spans)):
                    to[:] = 0
                    continue
                r0, r1 = np.int64(row_spans[row, 0]), np.int64(row_spans[row, 1])
                c0, c1 = np.int64(column_spans[column, 0]), np.int64(column_spans[column, 1])
                down, right = row_spans[row, 2], column_spans[column, 2]
                a, b, c, d = source[r0, c0], source[r0, c1], source[r1, c0], source[r1, c1]
                for m in range(channels):
                    above = (f32(1) - right) * max(a[m], zero) + right * max(b[m], zero)
                    below = (f32(1) - right) * max(c[m], zero) + right * max(d[m], zero)
                    to[m] = (f32(1) - down) * above + down * below


@njit(nogil=True, cache=True)
def scatter(tiles, corners, mask, target):
    """Write the cells of `tiles`, which have no halo, into `target` where `mask` (rows, columns) of
    the map is not 0."""
    rows, columns, channels = target.shape
    side, n, of, to = tiles.shape[1], np.uint64(channels), tiles.reshape(-1), target.reshape(-1)
    for i in range(len(corners)):
        r0, c0 = corners[i]
        for k in range(min(side, rows - r0)):
            here = np.uint64((i * side + k) * side * channels)
            there = np.uint64(((r0 + k) * columns + c0) * channels)
            for q in range(min(side, columns - c0)):
                if mask[r0 + k, c0 + q]:
                    for c in range(n):
                        to[there + c] = of[here + c]
                here += n
                there += n


@njit(nogil=True, cache=True)
def smooth(context, corners, cells, kept, smoothed):
    """Move `smoothed` toward `context` in the `cells` (n, side, side) of tiles."""
    rows, columns, channels = context.shape
    side, n, of, to = cells.shape[1], np.uint64(channels), context.reshape(-1), smoothed.reshape(-1)
    for i in range(len(corners)):
        r0, c0 = corners[i]
        for k in range(min(side, rows - r0)):
            at = np.uint64(((r0 + k) * columns + c0) * channels)
            for q in range(min(side, columns - c0)):
                if cells[i, k, q]:
                    for c in range(at, at + n):
                        to[c] = of[c] + kept * (to[c] - of[c])
                at += n


@njit(nogil=True, cache=True)
def write_pixels(tiles, corners, evidence, half, revealed, light, totals):
    """Write tiles (n, t, t, pixels) of the pixels of 2 x 2 cells, row by row, into `light`, times
    how far `evidence` has `revealed` their cell, `half` for half of it; `corners`: in 2 x 2 cells;
    `totals` follow the sums over cells of the weight and the light of blend_background."""
    side = 2 * CELL
    squares_down, squares_across = len(light) // side, light.shape[1] // side
    across, of, n = tiles.shape[2], tiles.reshape(-1), np.uint64(CELL)
    for i in range(len(corners)):
        r0, c0 = corners[i]
        weight, gained = 0.0, 0.0  # float64: no drift
        for k in range(min(tiles.shape[1], squares_down - r0)):
            for a in range(side):
                cells = 2 * (r0 + k) + a // CELL
                row, known, now = light[side * (r0 + k) + a], evidence[cells], revealed[cells]
                to, cell = np.uint64(side * c0), np.uint64(2 * c0)
                at = np.uint64(((i * tiles.shape[1] + k) * across * side + a) * side)
                for _ in range(min(across, squares_across - c0)):
                    for _ in range(2):
                        part, old = known[cell] / (known[cell] + half), now[cell]
                        rest, old_rest = np.float64(1) - part, np.float64(1) - old
                        for b in range(n):
                            new = part * of[at + b]
                            gained += rest * new - old_rest * row[to + b]
                            row[to + b] = new
                        if a % CELL == CELL - 1:
                            weight += rest * part - old_rest * old
                            now[cell] = part
                        cell += np.uint64(1)
                        to += n
                        at += n
                    at += np.uint64(side * side - side)
        totals[0] += weight
        totals[1] += gained / CELL**2


@njit(nogil=True, cache=True)
def add_background(light, revealed, background, frame):
    """Write `light` into `frame`, and `background` as far as a cell is not `revealed`."""
    for r in range(len(revealed)):
        for a in range(CELL):
            row, of, known = frame[CELL * r + a], light[CELL * r + a], revealed[r]
            for c in range(len(known)):
                hidden = (f32(1) - known[c]) * background
                for b in range(CELL):
                    row[CELL * c + b] = of[CELL * c + b] + hidden
