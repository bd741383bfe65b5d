"""What an engine is given: sensors' numbers as integers, keys, clock and memory."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import ndtri
from torch import Tensor

DEFER, DELETE, HOLD = 0, 1, 2
VOXELS, COUNT, LIST = 0, 1, 2
KEYS = 4  # of a view of a clip, in this order:
MISMATCH_KEY, HOT_KEY, SHOT_KEY, RESIDUAL_KEY = range(KEYS)
NORMAL_CELLS = 4096
LOWEST, HIGHEST = -1e-4, 1 + 1e-4  # intensities that a sensor takes: [0, 1] and a little rounding

# A clip's numbers.  on, off: thresholds, 2**-20 nat.  spread: relative mismatch, 2**-20.
# hot_share: share of hot pixels, 2**-32.  leak: per interval, 2**-24 thresholds.  shot, hot:
# probabilities of a noise event per interval, 2**-32.  top, left: the crop's place in a frame
# full_width wide.  low_pass: which row of Job.low_pass.  wait: the dead time in intervals, a
# float32's value.  residual: the largest distance of a reference from the first level, thresholds.
WHOLE = (
    "on", "off", "spread", "hot_share", "leak", "shot", "hot", "top", "left", "full_width",
    "low_pass",
)  # fmt: skip
CLIP = np.dtype(
    [(name, np.int64) for name in WHOLE] + [("wait", np.float64), ("residual", np.float64)]
)


@dataclass
class State:
    """What the pixels remember between frames; tensors are (n, views, h, w).

    `level` and `source`: the last frame's level after and before the low-pass, int32 multiples of
    2**-20 nat; `reference`: the memorised level; `dead`: the end of the dead time, in frame
    intervals after the last frame; `frame`: how many intervals have been simulated.
    """

    level: Tensor
    source: Tensor
    reference: Tensor
    dead: Tensor
    frame: int = 0


def blank(shape: tuple[int, int, int, int], device: torch.device) -> State:
    """Return memory (n, views, h, w) to be filled by a first frame."""
    levels = (torch.empty(shape, dtype=torch.int32, device=device) for _ in range(3))
    return State(*levels, torch.empty(shape, device=device))


@dataclass(frozen=True)
class Job:
    """One call of the sensors of n clips.

    `frames` (n, views, frames, h, w), float32 or float16, with `fresh` the first only sets the
    references; `level` (nodes,), the table of response.py, and `low_pass` (rows, 2, nodes), decay
    and lag at the same nodes, no row if there is no low-pass; `state`, overwritten; `edges`
    (n, frames): each clip's clock in microseconds at the frames; `clips` (n,) of CLIP;
    `keys` (n, views, 4): those of mismatch, hot pixels, shot noise and residual, 0 where not drawn.
    """

    frames: Tensor
    fresh: bool
    level: Tensor
    low_pass: Tensor
    state: State
    edges: np.ndarray
    substeps: int
    mode: int
    v2e: bool
    clips: np.ndarray
    keys: np.ndarray

    @property
    def intervals(self) -> int:
        """Return the number of frame intervals to simulate."""
        return self.frames.shape[2] - self.fresh


class Chip(NamedTuple):
    """A Job's numbers as a kernel takes them; `width`: of the frames."""

    level: np.ndarray
    low_pass: np.ndarray
    normals: np.ndarray
    clips: np.ndarray
    keys: np.ndarray
    width: int
    mode: int
    v2e: bool


class Memory(NamedTuple):
    """A State as a kernel takes it."""

    level: np.ndarray
    source: np.ndarray
    reference: np.ndarray
    dead: np.ndarray


class Sink(NamedTuple):
    """Where events go: grids (n, windows, views, bins, pixels), or numbers per unit and polarity,
    or a list at each unit's offset.
    """

    output: int
    voxels: np.ndarray
    counts: np.ndarray
    offsets: np.ndarray
    events: np.ndarray


class Scratch(NamedTuple):
    """Arrays over the pixels of a unit for one interval, and a batch of events (the last three).

    `pixel`: the number in the whole frame; `drawn`: random bits; `mixed`: the part of a pixel's
    noise that is the same in all frames; `hot`: the hot pixels, which come first; `drift`: what the
    reference leaks; `intensity`, of float16 frames, and `level`: the new frame's; `noisy`: whether
    there is a noise event; `active`: those pixels that are `busy`; `noise_u`, `noise_sign`: time
    and polarity of their noise events; `who`, `when`, `sign`: an event's pixel of the unit,
    fraction of the interval and polarity.
    """

    pixel: np.ndarray
    drawn: np.ndarray
    mixed: np.ndarray
    on: np.ndarray
    off: np.ndarray
    hot: np.ndarray
    drift: np.ndarray
    intensity: np.ndarray
    level: np.ndarray
    noisy: np.ndarray
    active: np.ndarray
    busy: np.ndarray
    noise_u: np.ndarray
    noise_sign: np.ndarray
    who: np.ndarray
    when: np.ndarray
    sign: np.ndarray


def normal_table() -> np.ndarray:
    """Return the standard normal's quantiles at 4097 nodes in 2**-20, of deviation 1 in all."""
    inner = ndtri(np.arange(1, NORMAL_CELLS) / NORMAL_CELLS)
    z = np.concatenate([[ndtri(1 / 4 / NORMAL_CELLS)], inner, [-ndtri(1 / 4 / NORMAL_CELLS)]])
    variance = (z[1:] ** 2 + z[1:] * z[:-1] + z[:-1] ** 2).mean() / 3
    return np.rint(z / np.sqrt(variance) * 2**20).astype(np.int64)


NORMALS = normal_table()
