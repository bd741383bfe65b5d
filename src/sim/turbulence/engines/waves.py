"""The passes about the matrix products that sum up plane waves (phase.py), on the CPU."""

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, fastmath=True)
def spread(real, imag, cos, sin):
    """Return each wave along the rows: its even part about the middle column, and its odd one.

    `real`, `imag` (lines, waves) of the amplitudes, `cos`, `sin` (rows, waves) of the phase in a
    row; the parts are (lines * rows, waves).
    """
    (lines, waves), rows = real.shape, cos.shape[0]
    even, odd = np.empty((2, lines * rows, waves), np.float32)
    for line in range(lines):
        a, b = real[line], imag[line]
        for row in range(rows):
            c, s, one, two = cos[row], sin[row], even[line * rows + row], odd[line * rows + row]
            for i in range(waves):
                one[i] = a[i] * c[i] - b[i] * s[i]
            for i in range(waves):
                two[i] = a[i] * s[i] + b[i] * c[i]
    return even, odd


@njit(nogil=True, cache=True, fastmath=True)
def join(even, odd, out):
    """Write the sums over waves to the lines of `out` (lines, columns): even less odd part from the
    middle to the right, even and odd part to the left."""
    columns = out.shape[1]
    left, middle = columns // 2, columns % 2
    for line in range(out.shape[0]):
        e, o, right = even[line], odd[line], out[line, left:]
        for i in range(columns - left):
            right[i] = e[i] - o[i]
        for i in range(left):
            out[line, left - 1 - i] = e[i + middle] + o[i + middle]
