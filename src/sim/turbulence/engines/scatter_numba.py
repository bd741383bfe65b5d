"""Normalised scatter on the CPU: PSFs drawn from their weights, and the light they spread."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def scatter_normalised(image, nodes, frame, basis, ends, row, column, pitch, halo, share):
    """Return the light of `image` (h, w) spread by PSFs over what white light would give.

    `nodes` (rank, frames, rows, columns) holds the weights of the basis functions of `frame`,
    sorted by parity (`ends`: where each of the four ends), on a lattice of `pitch` pixels.
    `basis` (middle + 1, middle + 1, 1 + rank): mean and functions for the pixels right of and below
    the middle of a PSF.  The first pixel of `image` lies `row`, `column` pixels after the first
    node; the result lacks `middle` pixels on every side.  `halo` is the light from beyond the PSFs,
    `share` that of a white scene.
    """
    size = 2 * len(basis) - 1
    height, width = image.shape
    light = halo.copy()
    white = np.full_like(halo, share)
    above = np.empty((size, size, width), np.float32)
    below = np.empty((size, size, width if pitch > 1 else 0), np.float32)
    lines = np.empty((nodes.shape[0], width), np.float32)
    sums = np.empty((4, width), np.float32)
    cells, lates = np.empty(width, np.int64), np.empty(width, np.float32)
    for x in range(width):
        cells[x] = (x + column) // pitch
        lates[x] = (x + column - cells[x] * pitch) / pitch
    last, current = nodes.shape[2] - 1, -2
    for y in range(height):
        cell = (y + row) // pitch
        late = np.float32((y + row - cell * pitch) / pitch)
        if cell != current:
            above, below = (below, above) if pitch > 1 else (above, below)
            if cell != current + 1 or pitch == 1:
                _stretch(nodes, frame, cell, pitch, cells, lates, lines)
                _draw(lines, basis, ends, sums, above)
            if pitch > 1:
                _stretch(nodes, frame, min(cell + 1, last), pitch, cells, lates, lines)
                _draw(lines, basis, ends, sums, below)
            current = cell
        for v in range(max(0, size - 1 - y), min(size, height - y)):
            target = y - size + 1 + v
            if late > 0:
                _add_between(light[target], white[target], image[y], above[v], below[v], late)
            else:
                _add(light[target], white[target], image[y], above[v])
    return light / white


@njit(nogil=True, cache=True, fastmath=True)
def _stretch(nodes, frame, row, pitch, cells, lates, lines):
    """Interpolate one row of nodes along x to the pixels, each `lates` of the way in its cell."""
    width, end = lines.shape[1], nodes.shape[3] - 1
    for i in range(lines.shape[0]):
        node, line = nodes[i, frame, row], lines[i]
        if pitch == 1:  # numba compiles `line[:] = node` for a second longer
            for x in range(width):
                line[x] = node[x]
            continue
        for x in range(width):
            low, high = node[cells[x]], node[min(cells[x] + 1, end)]
            line[x] = low + lates[x] * (high - low)


@njit(nogil=True, cache=True, fastmath=True)
def _draw(lines, basis, ends, sums, full):
    """Draw the PSFs `full` (size, size, pixels) of one row; none is negative.

    A basis function is even or odd under the mirror of rows and under that of columns, so four
    pixels of the PSF are the same four sums with different signs.
    """
    middle = full.shape[0] // 2
    for i in range(middle + 1):
        for j in range(middle + 1):
            shape = basis[i, j]
            sums.fill(np.float32(0.0))
            sums[0].fill(shape[0])
            first = 0
            for kind in range(4):
                _sum(sums[kind], lines, shape, first, ends[kind])
                first = ends[kind]
            _mix(full[middle + i, middle + j], sums, np.float32(1.0), np.float32(1.0))
            _mix(full[middle + i, middle - j], sums, np.float32(1.0), np.float32(-1.0))
            _mix(full[middle - i, middle + j], sums, np.float32(-1.0), np.float32(1.0))
            _mix(full[middle - i, middle - j], sums, np.float32(-1.0), np.float32(-1.0))


@njit(nogil=True, cache=True, fastmath=True)
def _sum(line, lines, shape, first, last):
    """Add the weighted basis functions first .. last - 1, `shape` of them at one pixel."""
    pairs = first + (last - first) // 2 * 2
    for i in range(first, pairs, 2):
        a, b = shape[1 + i], shape[2 + i]
        one, two = lines[i], lines[i + 1]
        for x in range(line.shape[0]):
            line[x] += a * one[x] + b * two[x]
    for i in range(pairs, last):
        a, one = shape[1 + i], lines[i]
        for x in range(line.shape[0]):
            line[x] += a * one[x]


@njit(nogil=True, cache=True, fastmath=True)
def _mix(line, sums, down, across):
    """Join the sums of the four symmetries at a mirrored place; `down`, `across`: 1 or -1."""
    both = down * across
    for x in range(line.shape[0]):
        value = sums[0, x] + across * sums[1, x] + down * sums[2, x] + both * sums[3, x]
        line[x] = max(value, np.float32(0.0))


@njit(nogil=True, cache=True, fastmath=True)
def _add(light, white, image, psfs):
    """Add one row of sources to one row of the result, two columns of the PSFs at a time."""
    size, width = psfs.shape[0], light.shape[0]
    for u in range(0, size - 1, 2):
        o = size - 1 - u
        first, second = psfs[u, o : o + width], psfs[u + 1, o - 1 : o - 1 + width]
        one, two = image[o : o + width], image[o - 1 : o - 1 + width]
        for x in range(width):
            white[x] += first[x] + second[x]
            light[x] += first[x] * one[x] + second[x] * two[x]
    psf = psfs[size - 1]
    for x in range(width):
        white[x] += psf[x]
        light[x] += psf[x] * image[x]


@njit(nogil=True, cache=True, fastmath=True)
def _add_between(light, white, image, above, below, late):
    """Add one row of sources whose PSFs lie `late` of the way between two rows of them."""
    size, width = above.shape[0], light.shape[0]
    for u in range(0, size - 1, 2):
        o = size - 1 - u
        first, after = above[u, o : o + width], below[u, o : o + width]
        second, behind = above[u + 1, o - 1 : o - 1 + width], below[u + 1, o - 1 : o - 1 + width]
        one, two = image[o : o + width], image[o - 1 : o - 1 + width]
        for x in range(width):
            a = first[x] + late * (after[x] - first[x])
            b = second[x] + late * (behind[x] - second[x])
            white[x] += a + b
            light[x] += a * one[x] + b * two[x]
    first, after = above[size - 1], below[size - 1]
    for x in range(width):
        a = first[x] + late * (after[x] - first[x])
        white[x] += a
        light[x] += a * image[x]
