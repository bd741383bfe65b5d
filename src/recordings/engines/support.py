"""One pass over a list of events: which have had a neighbour lately."""

from numba import njit

LONG_AGO = -(2**62)  # us


@njit(nogil=True, cache=True)
def support(t, x, y, latest, within, kept):
    """Write to `kept` which events are supported, and their times to `latest` (h + 2, w + 2)."""
    for i in range(t.size):
        row, column = y[i] + 1, x[i] + 1
        own = latest[row, column]
        latest[row, column] = LONG_AGO
        newest = LONG_AGO
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                newest = max(newest, latest[r, c])
        kept[i] = t[i] - newest <= within
        latest[row, column] = max(own, t[i])
