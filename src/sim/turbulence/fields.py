"""Displacement fields of real air: what the corners of a still scene did, joined in space and time.

Places are pixels of the footage, its smaller side taken for SIDE_PX; x runs right, y down.
"""

from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RBFInterpolator
from torch import Tensor

from src.sim.scenes.videos import sources
from src.sim.turbulence.corners import track

KEY = "turbulence.root"  # where the footage is named
SIDE_PX = 256
MOST_FRAMES = 120  # of the footage that are used
FEWEST_FRAMES, FEWEST_CORNERS = 8, 20
NODE_PX = 2.0  # between the nodes of a field
SMOOTHING = 10.0  # of the thin-plate spline: what meets held-out corners of real footage best


@dataclass(frozen=True)
class Fields:
    """Displacement (x, y), of 1 px rms along an axis, on nodes over `height_px` x `width_px`.

    Between nodes and between frames lies a cubic spline, beyond the ends their mirror image: in
    time the footage is played to and fro.
    """

    nodes: Float[Tensor, "frames 2 rows columns"]
    height_px: float
    width_px: float

    def at(
        self,
        time: Float[NDArray, " time"],
        y: Float[NDArray, " y"],
        x: Float[NDArray, " x"],
    ) -> Float[Tensor, "time 2 y x"]:
        """Return the displacement at `time`, in frames of the footage, at every (y, x)."""
        frames, _, rows, columns = self.nodes.shape
        when = _spline(frames, time)
        down = _spline(rows, y * (rows - 1) / self.height_px)
        across = _spline(columns, x * (columns - 1) / self.width_px)
        return down @ torch.einsum("tk,kcij->tcij", when, self.nodes) @ across.T


@lru_cache(maxsize=4)
def fields(root: Path) -> Fields:
    """Return the displacement fields of the footage at `root`, a video or a folder of frames.

    Raises ValueError where there is not one video, it is too short, or too few of its corners stay.
    """
    videos = sources(root, KEY)
    if len(videos) > 1:
        raise ValueError(f"{KEY} must be one video or one folder of frames, got {len(videos)}")
    footage = list(islice(videos[0].read(0, videos[0].count), MOST_FRAMES))
    if len(footage) < FEWEST_FRAMES:
        raise ValueError(f"{KEY} must show {FEWEST_FRAMES} frames or more, got {len(footage)}")
    moved, at, tried = track(footage, SIDE_PX)
    if len(at) < FEWEST_CORNERS:
        raise ValueError(
            f"{KEY} must show a still scene of which {FEWEST_CORNERS} corners or more can be "
            f"followed, got {len(at)} of {tried} in {root}"
        )
    return join(moved, at)


def join(moved: Float[NDArray, "frames corners 2"], at: Float[NDArray, "corners 2"]) -> Fields:
    """Join the displacements of corners at places `at` to fields over the rectangle they fill."""
    low, high = at.min(0), at.max(0)
    width, height = (high - low).tolist()
    y = np.linspace(0, height, round(height / NODE_PX) + 1)
    x = np.linspace(0, width, round(width / NODE_PX) + 1)
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    values = moved.transpose(1, 0, 2).reshape(len(at), -1)
    joined = RBFInterpolator(at - low, values, smoothing=SMOOTHING)(places)
    nodes = torch.from_numpy(joined).reshape(len(y), len(x), len(moved), 2).permute(2, 3, 0, 1)
    return Fields((nodes / nodes.square().mean().sqrt()).float().contiguous(), height, width)


def _spline(knots: int, at: Float[NDArray, " at"]) -> Float[Tensor, "at knots"]:
    """Return the weight of knots 0, 1, ... in a cubic spline at `at`, mirrored beyond its ends."""
    last = knots - 1
    folded = last - np.abs(at % (2 * last) - last)
    weights = CubicSpline(np.arange(knots), np.eye(knots), bc_type="clamped")(folded)
    return torch.from_numpy(weights).float()
