"""The network of p2s_network.py on the CPU: a block of nodes at a time, in the fastest cache."""

import numpy as np
from numba import njit

BLOCK = 192  # nodes
ZERO, THREE, SIX, SIXTH = np.float32(0), np.float32(3), np.float32(6), np.float32(1 / 6)


@njit(nogil=True, cache=True, fastmath=True)
def weights(phase, own, usual, layers):
    """Return the weights (rank, nodes) of the basis functions, sorted by kind.

    `phase` (blurmodes, nodes) in rad, of whose rows `own` says which are of each kind; `usual`:
    (D/r0 / edge)^(5/3); `layers`: Network.matrices.
    """
    form0, form1, form2, form3, common, even, factor0, factor1, factor2, factor3 = layers[:10]
    pair_gates, both, pairs, third1, third2, gate1, gate2, odd1, odd2 = layers[10:]
    few, width, nodes = len(factor0), len(common), phase.shape[1]
    first = len(form0)
    second, third, last = first + few, first + 2 * few, first + 2 * few + len(form3)
    e1 = len(even)
    e2, e3 = e1 + len(odd1), e1 + len(odd1) + len(odd2)
    out = np.empty((e3 + len(both), nodes), np.float32)
    part, found = np.empty((len(phase), BLOCK), np.float32), np.empty((len(out), BLOCK), np.float32)
    forms, squares = np.empty((last, BLOCK), np.float32), np.empty((last + 1, BLOCK), np.float32)
    squares[last] = usual
    known, other = np.empty((width, BLOCK), np.float32), np.empty((2 * few, BLOCK), np.float32)
    twos, mixed = np.empty((2 * few, BLOCK), np.float32), np.empty((few, BLOCK), np.float32)
    single = np.empty((2 * few, BLOCK), np.float32)
    n1, n2, n3 = len(own[0]), len(own[0]) + len(own[1]), len(phase) - len(own[3])
    for start in range(0, nodes, BLOCK):
        stop = min(start + BLOCK, nodes)
        _gather(phase, own, start, stop, part)
        p0, p1, p2, p3 = part[:n1], part[n1:n2], part[n2:n3], part[n3:]
        _linear(form0, p0, forms[:first])
        _linear(form1, p1, forms[first:second])
        _linear(form2, p2, forms[second:third])
        _linear(form3, p3, forms[third:])
        _times(forms, forms, squares[:last])
        _linear(common, squares, known)
        _hardswish(known)
        _linear(even, known, found[:e1])
        _linear(factor0, p0, twos[:few])
        _linear(factor3, p3, other[:few])
        _linear(factor1, p1, twos[few:])
        _linear(factor2, p2, other[few:])
        _times(twos, other, twos)
        _linear(pair_gates, known, other)
        _times(twos, other, twos)
        _linear(both, twos, found[e3:])
        _linear(pairs, twos, mixed)
        _odd(gate1, third1, known, p2, forms[first:second], mixed, other[:few], single)
        _linear(odd1, single, found[e1:e2])
        _odd(gate2, third2, known, p1, forms[second:third], mixed, other[:few], single)
        _linear(odd2, single, found[e2:e3])
        for i in range(len(out)):
            out[i, start:stop] = found[i, : stop - start]
    return out


@njit(nogil=True, fastmath=True)
def _odd(gate, third, known, phase, form, mixed, spare, single):
    """Write a gated linear form and products of three, all of one kind, to `single`."""
    few = len(form)
    _linear(gate, known, spare)
    _times(form, spare, single[:few])
    _linear(third, phase, spare)
    _times(mixed, spare, single[few:])


@njit(nogil=True, fastmath=True)
def _gather(phase, own, start, stop, part):
    """Sort the modes of a block by kind; a block that is not full keeps old numbers at its end."""
    place = 0
    for rows in own:
        for row in rows:
            line, to = phase[row], part[place]
            for x in range(stop - start):
                to[x] = line[start + x]
            place += 1


@njit(nogil=True, fastmath=True)
def _linear(matrix, inputs, out):
    """Write matrix[:, :-1] @ inputs + matrix[:, -1] to `out`, two rows by four inputs at a time."""
    count, last = out.shape[1], matrix.shape[1] - 1
    twos, fours = len(matrix) // 2 * 2, last // 4 * 4
    for j in range(len(matrix)):
        line, constant = out[j], matrix[j, last]
        for x in range(count):
            line[x] = constant
    for j in range(0, twos, 2):
        for i in range(0, fours, 4):
            _two_by_four(matrix[j, i:], matrix[j + 1, i:], inputs[i:], out[j], out[j + 1])
    for j in range(len(matrix)):
        for i in range(fours if j < twos else 0, last):
            a, one, line = matrix[j, i], inputs[i], out[j]
            for x in range(count):
                line[x] += a * one[x]


@njit(nogil=True, fastmath=True, inline="always")
def _two_by_four(row, other, inputs, line, below):
    """Add the first four of `inputs`, weighed by `row`, to `line`, and by `other`, to `below`."""
    a, b, c, d = row[0], row[1], row[2], row[3]
    e, f, g, h = other[0], other[1], other[2], other[3]
    one, two, three, four = inputs[0], inputs[1], inputs[2], inputs[3]
    for x in range(len(line)):
        line[x] += a * one[x] + b * two[x] + c * three[x] + d * four[x]
        below[x] += e * one[x] + f * two[x] + g * three[x] + h * four[x]


@njit(nogil=True, fastmath=True)
def _times(one, two, out):
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
