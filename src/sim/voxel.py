"""Events to voxel grid: bilinear in time between the window's edges (Rebecq et al. 2019, eq. 1).

An event at time t has the place tau = (bins - 1) (t - t0) / (t1 - t0) and adds p (1 - f) to bin
floor(tau) and p f to the next, f its fraction.  The edges are the window's, not the first and
last event, so that all views share one clock and an empty view shifts nothing.
"""

import warnings
from numbers import Integral
from typing import no_type_check

import numpy as np
import torch
from jaxtyping import Float
from numba import njit
from numpy.typing import ArrayLike
from torch import Tensor

from src.sim.user_values import describe_coarse_times, is_number, read_array

f32 = np.float32


def voxel_grid(
    t: ArrayLike, x: ArrayLike, y: ArrayLike, p: ArrayLike, *, t0: float, t1: float, bins: int,
    height: int, width: int,
) -> Float[Tensor, "bins h w"]:  # fmt: skip
    """Return the grid, float32, of the events with t0 <= t <= t1; zeros without any.  Warns where
    events are given and none lies in the window, or the type of `t` hardly resolves it.

    Windows that follow each other share an edge: cut a list into t0 <= t < t1 first, as
    `EventSensor.voxels` does, or an event on the edge counts in both.
    `t`, in the unit of `t0` and `t1` and in any order; `x`, `y` in pixels; `p` in {-1, 1} or
    {0, 1}, in each call by itself: without any -1 in it 0 is OFF, beside -1 it is refused.  All are
    arrays or tensors of one length.  Each event's weights are multiples of 2**-20, so that sums of
    up to 16 events a cell are exact and do not depend on their order.  Raises ValueError for
    coordinates outside or no whole numbers, lengths that differ, t1 <= t0, edges that are no finite
    numbers, times that are no finite numbers, another polarity, masked arrays, and tensors that
    NumPy does not read.
    """
    given = {"t": t, "x": x, "y": y, "p": p}
    t, x, y, p = (_as_native_array(name, values) for name, values in given.items())
    if not t.shape == x.shape == y.shape == p.shape or t.ndim != 1:
        shapes = [part.shape for part in (t, x, y, p)]
        raise ValueError(f"t, x, y, p must be of one length, got shapes {shapes}")
    sizes = bins, height, width
    if not all(isinstance(size, Integral) and size >= 1 for size in sizes):
        raise ValueError(f"bins, height, width must be whole numbers >= 1, got {sizes}")
    are_numbers = is_number(t0) and is_number(t1)
    if not (are_numbers and t1 > t0 and np.isfinite(t0) and np.isfinite(t1)):
        raise ValueError(f"voxel_grid needs finite t0 < t1, got t0={t0!r}, t1={t1!r}")
    grid, t0, t1 = torch.zeros(sizes, dtype=torch.float32), float(t0), float(t1)
    if t.size == 0:
        return grid
    if x.dtype.kind not in "iu" or y.dtype.kind not in "iu":
        raise ValueError(f"x and y must be whole numbers, got {x.dtype} and {y.dtype}")
    if t.dtype.kind not in "iuf" or p.dtype.kind not in "iufb":
        raise ValueError(f"t and p must be real numbers, got {t.dtype} and {p.dtype}")
    if t.dtype.kind == "f" and not np.isfinite(t).all():
        raise ValueError(f"t must be finite, event {int(np.isfinite(t).argmin())} is not")
    if t.max() < t0 or t.min() > t1:
        reach = f"{t.min()} to {t.max()}, the window is {t0} to {t1}"
        warnings.warn(
            f"no event lies in the window: t is {reach}; is its unit the same?", stacklevel=2
        )
    elif said := describe_coarse_times(t, t1 - t0):
        warnings.warn(said, stacklevel=2)
    times = t.astype(np.int64) if t.dtype.kind in "iu" else t.astype(np.float64)
    p = p.astype(np.float32) if p.dtype == np.float16 else p
    scale = np.float32(np.float32(bins - 1) / np.float32(t1 - t0))
    wrong = accumulate_until_bad_event(
        times, x, y, p, t0, t1, scale, bool(p.min() >= 0), grid.numpy()
    )
    if wrong >= 0:
        raise ValueError(
            f"events must have x in 0..{width - 1}, y in 0..{height - 1}, p in {{-1, 1}} or "
            f"{{0, 1}}; event {wrong} is x={x[wrong]} y={y[wrong]} p={p[wrong]}"
        )
    return grid


def _as_native_array(name: str, values: ArrayLike) -> np.ndarray:
    array = read_array(name, values)
    return array if array.dtype.isnative else array.astype(array.dtype.newbyteorder("="))


def normalise_nonzero(grid: Float[Tensor, "*batch bins h w"]) -> Float[Tensor, "*batch bins h w"]:
    """Return each grid with the mean and deviation of its non-zero cells taken out (E2VID).

    Cells that are zero stay zero.  Where the non-zero cells have no spread (one event, say) E2VID
    divides by zero; here they are left at mean 0 by dividing by 1.
    """
    filled = grid != 0
    axes = (-3, -2, -1)
    number = filled.sum(axes, keepdim=True).clamp(min=1)
    mean = grid.sum(axes, keepdim=True) / number
    variance = (((grid - mean) * filled) ** 2).sum(axes, keepdim=True) / number
    spread = torch.where(variance > 1e-12, variance, 1.0).sqrt()
    return torch.where(filled, (grid - mean) / spread, 0.0)


@njit(nogil=True, cache=True)
@no_type_check  # a checked function would not compile
def accumulate_until_bad_event(t, x, y, p, t0, t1, scale, zero_is_off, grid):
    """Add the events with t0 <= t <= t1 to `grid`; return the index of a bad event, or -1."""
    bins, height, width = grid.shape
    for i in range(t.size):
        if not (0 <= x[i] < width and 0 <= y[i] < height):
            return i
        if p[i] == 1:
            sign = f32(1)
        elif p[i] == -1 or (p[i] == 0 and zero_is_off):
            sign = f32(-1)
        else:
            return i
        if not t0 <= t[i] <= t1:
            continue
        tau = f32(f32(t[i] - t0) * scale)
        b = min(np.int64(tau), bins - 1)
        late = f32(np.rint((tau - f32(b)) * f32(2**20)) * f32(2.0**-20))
        grid[b, y[i], x[i]] += sign * (f32(1) - late)
        if late > 0 and b + 1 < bins:
            grid[b + 1, y[i], x[i]] += sign * late
    return -1
