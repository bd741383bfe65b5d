"""One pass over a list of events: count them at their pixel of the view they fall into."""

from numba import njit


@njit(nogil=True, cache=True)
def mark(x, y, p, view, place, counts):
    """Add the polarity of every event to `counts` (views, h, w) at its nearest model pixel.

    `view` (sensor h, sensor w) holds the index of the view or -1 and `place` (sensor h, sensor w,
    2) the (u, v) in that view, as in `Lookup`.
    """
    _, height, width = counts.shape
    for i in range(x.size):
        index = view[y[i], x[i]]
        if index >= 0:
            u = min(max(int(place[y[i], x[i], 0] + 0.5), 0), width - 1)
            v = min(max(int(place[y[i], x[i], 1] + 0.5), 0), height - 1)
            counts[index, v, u] += p[i]
