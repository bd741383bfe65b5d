"""SetNet's clock from the pixels that had events (numba): bit for bit `cell_clock.run_clock`.

Maps are (rows, columns) of cells.  Whatever is dense in here is a pass or two over one map of
bytes or floats; all else follows the events and the tiles, of TILE x TILE cells, that they reach.
Thresholds and times are arguments: a compiled function that is kept on disk keeps its constants.
"""

import numpy as np
from numba import njit

from src.models.setnet import CELL_PX as SIDE

f32, u8 = np.float32, np.uint8

TILE = 8  # side of a tile, in cells
QUARTER = TILE // 2  # the same in cells of the context
TINY = f32(2.0**-126)  # what is smaller takes a processor a hundred times longer


@njit(nogil=True, cache=True)
def collect_pixels(t, x, y, p, view, t0, t1, slot_of, places, grid):
    """Lay the events with t0 <= t <= t1 into `grid` (n, bins), a row for each pixel that has any;
    return their number.  `places` (n, 3): view, row, column; `slot_of` (views, h, w): zeros.
    """
    bins, count, slots, voxels = grid.shape[1], 0, slot_of.reshape(-1), grid.reshape(-1)
    scale, height, width = f32(f32(bins - 1) / f32(t1 - t0)), slot_of.shape[1], slot_of.shape[2]
    for i in range(np.uint64(t.size)):
        if not t0 <= t[i] <= t1:
            continue
        tau = f32(f32(t[i] - t0) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        pixel = np.uint64((view[i] * height + y[i]) * width + x[i])
        slot = slots[pixel]
        if slot == 0:
            places[count, 0], places[count, 1], places[count, 2] = view[i], y[i], x[i]
            for k in range(bins):
                grid[count, k] = 0
            count += 1
            slots[pixel] = slot = count
        at = np.uint64((slot - 1) * bins + b)
        voxels[at] += p[i] * (f32(1) - late)
        if b + 1 < bins:
            voxels[at + np.uint64(1)] += p[i] * late
    for k in range(count):
        slot_of[places[k, 0], places[k, 1], places[k, 2]] = 0
    return count


@njit(nogil=True, cache=True)
def fade(kept, values):
    """Multiply `values` (n,) by `kept`."""
    for i in range(np.uint64(values.size)):
        value = values[i] * kept
        values[i] = value if value >= TINY else f32(0)


@njit(nogil=True, cache=True)
def count_supported_events(places, grid, kept, least, counts, trace, supported):
    """Bring `trace` (views, rows + 2, columns + 2), zero at its border, to the end of the window,
    and write into `supported` (rows, columns), zeros, how many events of a cell have support, more
    than `least`, in the view that has most.  Return (rows, 2), from where to where in each row.
    `counts` (views, rows, columns): zeros.
    """
    views, rows, columns = counts.shape
    fade(kept, trace.reshape(-1))
    first, stop = np.full((views, rows), columns, np.int32), np.zeros((views, rows), np.int32)
    flat = counts.reshape(-1)
    for k in range(len(places)):
        weight = f32(0)
        for b in range(grid.shape[1]):
            weight += abs(grid[k, b])
        v, r, c = places[k, 0], places[k, 1] // SIDE, places[k, 2] // SIDE
        flat[np.uint64((v * rows + r) * columns + c)] += weight
        first[v, r], stop[v, r] = min(first[v, r], c), max(stop[v, r], c + 1)
    for v, r in np.ndindex(first.shape):
        now, more = trace[v, r + 1, first[v, r] + 1 :], counts[v, r, first[v, r] :]
        for c in range(np.uint64(max(stop[v, r] - first[v, r], 0))):
            now[c] += more[c]
    spans = np.zeros((rows, 2), np.int32)
    for r in range(rows):
        begin, end = columns, 0
        for v in range(views):
            if first[v, r] < stop[v, r]:
                part = slice(first[v, r], stop[v, r])
                near = trace[v, r : r + 3, part.start : part.stop + 2]
                _find_supported_in_row(near, least, counts[v, r, part], supported[r, part])
                begin, end = min(begin, part.start), max(end, part.stop)
        while begin < end and supported[r, begin] == 0:
            begin += 1
        while begin < end and supported[r, end - 1] == 0:
            end -= 1
        spans[r, 0], spans[r, 1] = begin, max(begin, end)
    return spans


@njit(nogil=True, cache=True)
def _find_supported_in_row(near, least, count, supported):
    # Added up in the order of, and rounded as, an average pooling of 3 x 3.
    above, here, below = near[0], near[1], near[2]
    for c in range(np.uint64(count.size)):
        d, e = c + np.uint64(1), c + np.uint64(2)
        total = above[c] + above[d] + above[e] + here[c] + here[d] + here[e]
        total = total + below[c] + below[d] + below[e]
        others = f32(9) * (total / f32(9)) - here[d]
        supported[c] = max(supported[c], count[c] if others > least else f32(0))
        count[c] = 0


@njit(nogil=True, cache=True)
def spread(supported, spans, weights, evidence, is_near, near_tiles):
    """Add `supported` (rows, columns), smoothed by `weights` along both sides, to `evidence`; set
    `is_near` where that is anything, and `near_tiles` that have any; clear `supported`."""
    (rows, columns), reach = supported.shape, weights.size // 2
    line, smoothed = np.zeros(columns + 4 * reach, f32), np.zeros(columns, f32)
    for r in range(rows):
        first, stop = spans[r, 0], spans[r, 1]
        if first == stop:
            continue
        line[first : stop + 4 * reach] = 0
        for x in range(first, stop):  # an array assigned to a slice takes seconds to compile
            line[2 * reach + x] = supported[r, x]
        supported[r, first:stop] = 0
        begin, end = max(first - reach, 0), min(stop + reach, columns)
        n, smooth, given = np.uint64(end - begin), smoothed[begin:end], line[begin + reach :]
        smooth[:] = 0
        for k in range(np.uint64(weights.size)):
            for c in range(n):
                smooth[c] += weights[k] * given[c + k]
        top, bottom = max(r - reach, 0), min(r + reach, rows - 1)
        for q in range(top, bottom + 1):
            weight, known, near = weights[q - r + reach], evidence[q, begin:], is_near[q, begin:]
            for c in range(n):
                known[c] += weight * smooth[c]
                near[c] |= u8(smooth[c] > 0)
        for j in range(begin // TILE, (end - 1) // TILE + 1):
            if smoothed[max(j * TILE, begin) : min((j + 1) * TILE, end)].any():
                near_tiles[top // TILE : bottom // TILE + 1, j] = 1


@njit(nogil=True, cache=True)
def advance_clocks(
    window_s, kept, tau_s, floor, is_near, near_tiles, active_tiles, activity, elapsed_s,
    is_pending, pending_tiles, changed,
):  # fmt: skip
    """Advance the clock of every cell; return by how much at most, in seconds, and how many cells
    are active then.  `is_near` is cleared, and `near_tiles`.

    `active_tiles`: before and after, which tiles have a cell whose clock advances; `changed`: the
    tiles within the decoder's reach of one.
    """
    longest, total = f32(0), 0
    columns_used = np.empty(TILE, f32)
    for i, j in np.ndindex(active_tiles.shape):
        if not (near_tiles[i, j] or active_tiles[i, j]):
            continue
        near_tiles[i, j] = active_tiles[i, j] = 0
        columns_used[:] = 0
        first, last = TILE, -1
        r0, c0 = i * TILE, j * TILE
        width = np.uint64(min(TILE, activity.shape[1] - c0))
        for r in range(r0, min(r0 + TILE, len(activity))):
            near, active = is_near[r, c0 : c0 + width], activity[r, c0 : c0 + width]
            elapsed, pending = elapsed_s[r, c0 : c0 + width], is_pending[r, c0 : c0 + width]
            most = f32(0)
            for c in range(width):
                before = active[c]
                remaining = before * kept
                faded = tau_s * max(before - max(remaining, floor), f32(0))
                passed = window_s if near[c] else faded
                remaining = remaining if remaining >= floor else f32(0)
                active[c] = f32(1) if near[c] else remaining
                elapsed[c] = passed
                pending[c] = u8(1) if passed > 0 else pending[c]
                near[c] = 0
                total += active[c] > 0
                columns_used[c] = max(columns_used[c], passed)
                most = max(most, passed)
            if most > 0:
                first, last = min(first, r - r0), r - r0
                longest = max(longest, most)
        if last >= 0:
            active_tiles[i, j] = pending_tiles[i, j] = 1
            used = np.flatnonzero(columns_used)
            mark_tiles_near_box(r0 + first, r0 + last, c0 + used[0], c0 + used[-1], changed)
    return longest, total


@njit(nogil=True, cache=True)
def mark_tiles_near_box(first_row, last_row, first_column, last_column, changed):
    """Set the tiles of `changed` within two cells of a rectangle of cells."""
    top, stop = max(first_row - 2, 0) // TILE, (last_row + 2) // TILE + 1
    left, end = max(first_column - 2, 0) // TILE, (last_column + 2) // TILE + 1
    changed[top:stop, left:end] = 1


@njit(nogil=True, cache=True)
def find_cells_to_smooth(recency, settling, is_pending, pending_tiles, settling_tiles, changed):
    """Return the tiles (n, 2), and in each the cells (n, QUARTER, QUARTER), in which the smoothed
    context advances: pending ones, and those with a `recency` above `settling`; mark what they
    change.  `settling_tiles`: where any did without an update.
    """
    most = np.count_nonzero(pending_tiles | settling_tiles)
    tiles = np.empty((most, 2), np.int32)
    cells, count = np.zeros((most, QUARTER, QUARTER), u8), 0
    for i, j in np.ndindex(settling_tiles.shape):
        if not (pending_tiles[i, j] or settling_tiles[i, j]):
            continue
        settling_tiles[i, j] = 0
        top, bottom, left, right = QUARTER, -1, QUARTER, -1
        for r in range(min(QUARTER, len(recency) - i * QUARTER)):
            for c in range(min(QUARTER, recency.shape[1] - j * QUARTER)):
                row, column = i * QUARTER + r, j * QUARTER + c
                is_settling = recency[row, column] > settling
                if is_settling:
                    settling_tiles[i, j] = 1
                if is_settling or _has_pending(is_pending, row, column):
                    cells[count, r, c] = 1
                    top, bottom = min(top, r), max(bottom, r)
                    left, right = min(left, c), max(right, c)
        if bottom >= 0:
            tiles[count, 0], tiles[count, 1] = i, j
            count += 1
            r0, c0 = i * TILE, j * TILE
            mark_tiles_near_box(
                r0 + 2 * top, r0 + 2 * bottom + 1, c0 + 2 * left, c0 + 2 * right + 1, changed
            )
    return tiles[:count], cells[:count]


@njit(nogil=True, cache=True)
def _has_pending(is_pending, row, column):
    r, c = 2 * row, 2 * column
    return (
        is_pending[r, c] or is_pending[r, c + 1] or is_pending[r + 1, c] or is_pending[r + 1, c + 1]
    )
