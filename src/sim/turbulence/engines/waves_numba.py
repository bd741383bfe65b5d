"""The passes about the matrix products that sum up plane waves (plane_waves.py), on the CPU."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def split_even_odd(response, amplitudes, seen, cos, sin):
    """Return each wave along the rows: its even part about the middle column, and its odd one.

    `response` (modes, some, 2) of the waves that are `seen`, `amplitudes` (frames, waves, 2) of
    all, real and imaginary part; `cos`, `sin` (rows, some) of the phase in a row; the parts are
    (modes * frames * rows, some).
    """
    modes, frames, rows, some = len(response), len(amplitudes), len(cos), len(seen)
    even, odd = np.empty((2, modes * frames * rows, some), np.float32)
    a, b = np.empty((2, some), np.float32)
    for line in range(modes * frames):
        own, drawn = response[line // frames], amplitudes[line % frames]
        for i in range(some):
            c, d = drawn[seen[i], 0], drawn[seen[i], 1]
            a[i], b[i] = own[i, 0] * c - own[i, 1] * d, own[i, 0] * d + own[i, 1] * c
        for row in range(rows):
            c, s, one, two = cos[row], sin[row], even[line * rows + row], odd[line * rows + row]
            for i in range(some):
                one[i] = a[i] * c[i] - b[i] * s[i]
            for i in range(some):
                two[i] = a[i] * s[i] + b[i] * c[i]
    return even, odd


@njit(nogil=True, cache=True, fastmath=True)
def join_even_odd(even, odd, out):
    """Write even less odd part right of the middle of `out` (lines, columns), their sum left."""
    columns = out.shape[1]
    left, middle = columns // 2, columns % 2
    for line in range(out.shape[0]):
        e, o, right = even[line], odd[line], out[line, left:]
        for i in range(columns - left):
            right[i] = e[i] - o[i]
        for i in range(left):
            out[line, left - 1 - i] = e[i + middle] + o[i + middle]
