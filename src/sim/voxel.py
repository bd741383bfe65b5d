"""Events to voxel grid: bilinear in time between the window's edges (Rebecq et al. 2019, eq. 1).

An event at time t has the place tau = (bins - 1) (t - t0) / (t1 - t0) and adds p (1 - f) to bin
floor(tau) and p f to the next, f its fraction.  The edges are the window's, not the first and
last event, so that all views share one clock and an empty view shifts nothing.
"""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.engines.voxel_numba import accumulate


def voxel_grid(
    t, x, y, p, *, t0=None, t1=None, bins: int, height: int,
    width: int, window: str = "edges",
) -> Float[Tensor, "bins h w"]:  # fmt: skip
    """Return the grid of the events with t0 <= t <= t1; the others have no part in it.

    `t`, in the unit of `t0` and `t1` and in any order; `x`, `y` in pixels; `p` in {-1, 1} or
    {0, 1}: arrays or tensors of one length.  Each event's weights are multiples of 2**-20, so
    that sums of up to 16 events a cell are exact and do not depend on their order.
    `window="first_last"` takes t0 and t1 from the first and last event, as E2VID does; use it only
    to compare.  Raises ValueError for coordinates outside, lengths that differ, t1 <= t0 or another
    polarity.
    """
    t, x, y, p = (np.asarray(part) for part in (t, x, y, p))
    if not t.shape == x.shape == y.shape == p.shape or t.ndim != 1:
        shapes = [part.shape for part in (t, x, y, p)]
        raise ValueError(f"t, x, y, p must be of one length, got shapes {shapes}")
    if bins < 1 or height < 1 or width < 1:
        raise ValueError(f"bins, height, width must be positive, got {bins}, {height}, {width}")
    grid = torch.zeros(bins, height, width)
    t0, t1 = _edges(t, t0, t1, window)
    if t.size == 0:
        return grid
    places = t.astype(np.int64) if t.dtype.kind in "iu" else t.astype(np.float64)
    wrong = accumulate(
        places, x, y, p, t0, t1, np.float32(np.float32(bins - 1) / np.float32(t1 - t0)),
        bool(p.min() >= 0), grid.numpy(),
    )  # fmt: skip
    if wrong >= 0:
        raise ValueError(
            f"events must have x in 0..{width - 1}, y in 0..{height - 1}, p in {{-1, 1}} or "
            f"{{0, 1}}; event {wrong} is x={x[wrong]} y={y[wrong]} p={p[wrong]}"
        )
    return grid


def _edges(t: np.ndarray, t0, t1, window: str) -> tuple[float, float]:
    """Return the window's edges as floats that hold the event clock exactly."""
    if window == "first_last":
        if t.size == 0:
            return 0.0, 1.0
        t0, t1 = t.min(), t.max()
        t1 = t1 if t1 > t0 else t0 + 1  # one instant: everything lands in the first bin
    elif window != "edges":
        raise ValueError(f"window must be `edges` or `first_last`, got {window!r}")
    if t0 is None or t1 is None or not t1 > t0:
        raise ValueError(f"voxel_grid needs t0 < t1, got t0={t0}, t1={t1}")
    return float(t0), float(t1)


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
