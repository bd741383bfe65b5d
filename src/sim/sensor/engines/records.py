"""What an engine is given, as integers and arrays."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.special import ndtri
from torch import Tensor

DEFER, DELETE, HOLD = 0, 1, 2
KEYS = 4  # of a view of a clip, in this order:
MISMATCH_KEY, HOT_PIXEL_KEY, NOISE_KEY, REFERENCE_KEY = range(KEYS)
NORMAL_CELLS = 4096
LOWEST, HIGHEST = -1e-4, 1 + 1e-4  # intensities that a sensor takes: [0, 1] and a little rounding

# A clip's sensor.  on, off: thresholds, 2**-20 nat.  mismatch: relative deviation, 2**-20.
# hot_fraction: share of hot pixels, 2**-32.  leak: per interval, 2**-24 thresholds.  dark_noise,
# hot_noise: probabilities of a noise event per interval, 2**-32.  top, left: the crop's place in a
# frame full_width wide.  low_pass_row: of low_pass_tables.  refractory: the dead time in intervals,
# a float32's value.  A reference begins (u - reference_zero) * reference_span thresholds below
# the first level, u uniform in [0, 1).
WHOLE = (
    "on", "off", "mismatch", "hot_fraction", "leak", "dark_noise", "hot_noise", "top", "left",
    "full_width", "low_pass_row",
)  # fmt: skip
FIELDS = (*WHOLE, "refractory", "reference_zero", "reference_span")
CLIP = np.dtype([(name, np.int64 if name in WHOLE else np.float64) for name in FIELDS])
Grids = Float[Tensor, "n windows views bins h w"]
EVENT = np.dtype([("t", np.int64), ("x", np.uint16), ("y", np.uint16), ("p", np.int8)])


class EngineInput(NamedTuple):
    """The frames of n clips and the numbers of their sensors.

    `frames` (n, views, frames, h, w), float32 or float16, `width` their w; `level_table` (nodes,),
    of response.py; `low_pass_tables` (rows, 2, nodes), decay and lag at the same nodes, no row
    without a low-pass; these are tensors, for the CPU's kernels arrays, their frames' pixels in one
    axis.  `edges_us` (n, frames): each clip's clock at the frames; `clips` (n,) of CLIP; `keys`
    (n, views, KEYS): those of mismatch, hot pixels, noise events and references, 0 where not drawn;
    `first_interval`: the first between frames whose events are put out, by the CPU's kernels.
    """

    frames: Any
    level_table: Any
    low_pass_tables: Any
    edges_us: NDArray[np.int64]
    width: int
    substeps: int
    refractory_mode: int
    v2e_stamps: bool
    clips: np.ndarray
    keys: NDArray[np.int64]
    first_interval: int = 0


def check_intensities(frames: Tensor) -> None:
    """Raise ValueError for frames that are not finite or outside [0, 1]."""
    low, high = (end.float() for end in torch.aminmax(frames))
    if not (low >= LOWEST and high <= HIGHEST):
        raise ValueError(f"frames must be finite and in [0, 1], got {low:g} to {high:g}")


def _normal_quantiles() -> NDArray[np.int64]:
    """Return the standard normal's quantiles at 4097 nodes in 2**-20, of deviation 1 in all."""
    inner = ndtri(np.arange(1, NORMAL_CELLS) / NORMAL_CELLS)
    z = np.concatenate([[ndtri(1 / 4 / NORMAL_CELLS)], inner, [-ndtri(1 / 4 / NORMAL_CELLS)]])
    variance = (z[1:] ** 2 + z[1:] * z[:-1] + z[:-1] ** 2).mean() / 3
    return np.rint(z / np.sqrt(variance) * 2**20).astype(np.int64)


NORMALS = _normal_quantiles()
