"""Normalised scatter on the CPU: one pass over a picture, PSFs interpolated on the way."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def scatter(image, kernels, row, column, pitch, halo, share):
    """Return the light of `image` (h, w) spread by PSFs over what white light would give.

    `kernels` (rows, size, size, columns) stand on a lattice of `pitch` pixels; the first pixel of
    `image` lies `row`, `column` pixels after the first node.  The result lacks size // 2 pixels on
    every side.  `halo` is the light from beyond the kernels, `share` that of a white scene.  For
    every row of nodes the kernels are first drawn out to the pixels along x.
    """
    height, width = image.shape
    size = kernels.shape[1]
    light = halo.copy()
    white = np.full_like(halo, share)
    above = np.empty((size, size, light.shape[1]), np.float32)
    below = np.empty_like(above)
    source = np.empty((size, light.shape[1]), np.float32)
    current = -2
    for y in range(height):
        cell = (y + row) // pitch
        late = np.float32((y + row - cell * pitch) / pitch)
        if cell != current:
            above, below = below, above
            if cell != current + 1:
                _draw_out(kernels[cell], above, column, pitch)
            _draw_out(kernels[min(cell + 1, kernels.shape[0] - 1)], below, column, pitch)
            current = cell
        for u in range(size):
            source[u] = image[y, size - 1 - u : width - u]
        for v in range(max(0, size - 1 - y), min(size, height - y)):
            target = y - size + 1 + v
            _add_line(light[target], white[target], source, above[v], below[v], late)
    return light / white


@njit(nogil=True, cache=True, fastmath=True)
def _add_line(light, white, source, above, below, late):
    """Add one line of sources to one line of the result, four columns of the kernel at a time."""
    size = source.shape[0]
    whole = size // 4 * 4
    for u in range(0, whole, 4):
        for x in range(light.shape[0]):
            a = above[u, x] + late * (below[u, x] - above[u, x])
            b = above[u + 1, x] + late * (below[u + 1, x] - above[u + 1, x])
            c = above[u + 2, x] + late * (below[u + 2, x] - above[u + 2, x])
            d = above[u + 3, x] + late * (below[u + 3, x] - above[u + 3, x])
            white[x] += a + b + c + d
            light[x] += (
                a * source[u, x]
                + b * source[u + 1, x]
                + c * source[u + 2, x]
                + d * source[u + 3, x]
            )
    for u in range(whole, size):
        for x in range(light.shape[0]):
            a = above[u, x] + late * (below[u, x] - above[u, x])
            white[x] += a
            light[x] += a * source[u, x]


@njit(nogil=True, cache=True, fastmath=True)
def _draw_out(kernels, full, column, pitch):
    """Interpolate one row of nodes (size, size, columns) along x to `full` (size, size, pixels).

    Element [v, u, x] belongs to the source whose light reaches pixel x through kernel column u.
    """
    size, width = full.shape[0], full.shape[2]
    cell = np.empty(width, np.int64)
    upper = np.empty(width, np.int64)
    late = np.empty(width, np.float32)
    for u in range(size):
        for x in range(width):
            place = x + size - 1 - u + column
            cell[x] = place // pitch
            upper[x] = min(cell[x] + 1, kernels.shape[2] - 1)
            late[x] = (place - cell[x] * pitch) / pitch
        for v in range(size):
            node, line = kernels[v, u], full[v, u]
            for x in range(width):
                low = node[cell[x]]
                line[x] = low + late[x] * (node[upper[x]] - low)
