"""The network from phase to PSF weights on the CPU: a block of nodes at a time, in the cache."""

import numpy as np
from numba import njit

BLOCK = 256  # nodes
ZERO, THREE, SIX, SIXTH = (np.float32(number) for number in (0, 3, 6, 1 / 6))


@njit(nogil=True, cache=True, fastmath=True)
def evaluate_psf_network(phase, first, common, gates, pairs, last):
    """Return what a FoldedNetwork (p2s.py) of these matrices gives for `phase` (blurmodes, nodes).

    Most numbers of the matrices are 0, and passed over.
    """
    few, width, wide = len(pairs) // 2, len(common), common.shape[1] - 1
    one, two, three = width + 1, width + 1 + 2 * few, width + 1 + 4 * few
    used = _find_used(first), _find_used(common), _find_used(gates), _find_used(pairs)
    used_last, out = _find_used(last), np.empty((len(last), phase.shape[1]), np.float32)
    given = np.zeros((len(phase), BLOCK), np.float32)
    squares = np.ones((wide + 1, BLOCK), np.float32)
    parts = np.ones((last.shape[1], BLOCK), np.float32)
    forms, gated, mixed = _allocate(first), _allocate(gates), _allocate(pairs)
    found, known = _allocate(last), parts[:width]
    for start in range(0, phase.shape[1], BLOCK):
        stop = min(start + BLOCK, phase.shape[1])
        for i in range(len(phase)):
            _copy(phase[i, start:stop], given[i])
        _multiply(first, used[0], given, forms)
        _times(forms[:wide], forms[:wide], squares[:wide])
        _multiply(common, used[1], squares, known)
        _hardswish(known)
        _multiply(gates, used[2], parts, gated)
        _times(forms[wide : wide + 2 * few], forms[wide + 2 * few :], parts[one:two])
        _times(parts[one:two], gated, parts[one:two])
        _times(forms[2 * few : 4 * few], gated[2 * few :], parts[two:three])
        _multiply(pairs, used[3], parts[one:two], mixed)
        _times(mixed, forms[wide + 4 * few :], parts[three:])
        _multiply(last, used_last, parts, found)
        for i in range(len(out)):
            _copy(found[i, : stop - start], out[i, start:stop])
    return out


@njit(nogil=True)
def _copy(line, to):
    """Write `line` to the first of `to`.  Numba compiles `to[:] = line` for a second longer."""
    for x in range(len(line)):
        to[x] = line[x]


@njit(nogil=True)
def _allocate(matrix):
    """Return memory for the product of a matrix and a block; rows come in pairs."""
    return np.empty((len(matrix) + len(matrix) % 2, BLOCK), np.float32)


@njit(nogil=True)
def _find_used(matrix):
    """Return of every two rows how many columns are not 0 in both, and which."""
    used = np.zeros(((len(matrix) + 1) // 2, 1 + matrix.shape[1]), np.int64)
    for pair in range(len(used)):
        top, bottom = matrix[2 * pair], matrix[min(2 * pair + 1, len(matrix) - 1)]
        for j in range(len(top)):
            if top[j] != 0 or bottom[j] != 0:
                used[pair, 0] += 1
                used[pair, used[pair, 0]] = j
    return used


@njit(nogil=True, fastmath=True)
def _multiply(matrix, used, inputs, out):
    """Write the product of a matrix and `inputs` to `out`, two rows by four inputs at a time."""
    for pair in range(len(used)):
        top, bottom = matrix[2 * pair], matrix[min(2 * pair + 1, len(matrix) - 1)]
        line, below = out[2 * pair], out[2 * pair + 1]
        line.fill(ZERO)
        below.fill(ZERO)
        count, own = used[pair, 0], used[pair, 1:]
        fours = count // 4 * 4
        for i in range(0, fours, 4):
            _add_four(top, bottom, own[i:], inputs, line, below)
        for i in range(fours, count):
            a, e, one = top[own[i]], bottom[own[i]], inputs[own[i]]
            for x in range(len(line)):
                line[x] += a * one[x]
                below[x] += e * one[x]


@njit(nogil=True, fastmath=True, inline="always")
def _add_four(top, bottom, own, inputs, line, below):
    """Add the first four of `own`, weighed by `top`, to `line`, and by `bottom` to `below`."""
    i, j, k, m = own[0], own[1], own[2], own[3]
    a, b, c, d = top[i], top[j], top[k], top[m]
    e, f, g, h = bottom[i], bottom[j], bottom[k], bottom[m]
    one, two, three, four = inputs[i], inputs[j], inputs[k], inputs[m]
    for x in range(len(line)):
        line[x] += a * one[x] + b * two[x] + c * three[x] + d * four[x]
        below[x] += e * one[x] + f * two[x] + g * three[x] + h * four[x]


@njit(nogil=True, fastmath=True)
def _times(one, two, out):
    """Write the product of the first rows of `one` and `two` to `out`."""
    for i in range(len(out)):
        a, b, line = one[i], two[i], out[i]
        for x in range(len(line)):
            line[x] = a[x] * b[x]


@njit(nogil=True, fastmath=True)
def _hardswish(lines):
    for i in range(len(lines)):
        line = lines[i]
        for x in range(len(line)):
            value = line[x]
            line[x] = value * min(max(value + THREE, ZERO), SIX) * SIXTH
