"""What an engine is given: a sensor's numbers as integers, keys, clock and memory."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri
from torch import Tensor

DEFER, DELETE, HOLD = 0, 1, 2
VOXELS, COUNT, LIST = 0, 1, 2
NORMAL_CELLS = 4096


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


@dataclass(frozen=True)
class Job:
    """One call of a sensor.

    `frames` (n, views, frames, h, w), with `fresh` the first only sets the references; `tables`:
    level, decay and lag at the nodes of response.py (one node each if there is no low-pass);
    `state`, overwritten; `edges`: the clock in microseconds at the frames; `chips` (n, 4): ON and
    OFF threshold, relative mismatch in 2**-20, share of hot pixels in 2**-32; `leak`: per interval
    in 2**-24 thresholds; `shot`, `hot`: probabilities per interval in 2**-32; `wait`: the dead time
    in intervals; `chip_keys` (views, 2), `shot_keys` (n, views); `place`: top, left, full width.
    """

    frames: Tensor
    fresh: bool
    tables: tuple[Tensor, Tensor, Tensor]
    state: State
    edges: np.ndarray
    substeps: int
    mode: int
    v2e: bool
    wait: float
    chips: np.ndarray
    leak: int
    shot: int
    hot: int
    chip_keys: np.ndarray
    shot_keys: np.ndarray
    place: tuple[int, int, int]

    @property
    def intervals(self) -> int:
        """Return the number of frame intervals to simulate."""
        return self.frames.shape[2] - self.fresh


class Chip(NamedTuple):
    """A Job's numbers as a kernel takes them; `place`: top, left, full width, width."""

    tables: tuple
    normals: np.ndarray
    chips: np.ndarray
    chip_keys: np.ndarray
    shot_keys: np.ndarray
    place: tuple
    mode: int
    v2e: bool
    wait: np.float32
    leak: int
    shot: int
    hot: int


class Memory(NamedTuple):
    """A State as a kernel takes it."""

    level: np.ndarray
    source: np.ndarray
    reference: np.ndarray
    dead: np.ndarray


class Sink(NamedTuple):
    """Where events go: grids, or numbers per unit and polarity, or a list at each unit's offset."""

    output: int
    voxels: np.ndarray
    counts: np.ndarray
    offsets: np.ndarray
    events: np.ndarray


class Scratch(NamedTuple):
    """Arrays over the pixels of a unit for one interval, and a batch of events (the last three).

    `pixel`: the number in the whole frame; `drift`: what the reference leaks; `level`: the new
    frame's; `active`: those pixels that are `busy`; `who`, `when`, `sign`: an event's pixel of the
    unit, fraction of the interval and polarity.
    """

    pixel: np.ndarray
    on: np.ndarray
    off: np.ndarray
    hot: np.ndarray
    drift: np.ndarray
    level: np.ndarray
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
