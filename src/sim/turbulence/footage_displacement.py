"""Displacement fields of real turbulence: corners of a still scene, tracked and interpolated.

Places are pixels of the footage, its smaller side taken for SIDE_PX; x runs right, y down.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, RBFInterpolator
from torch import Tensor

from src.sim.scenes.video_files import find_videos
from src.sim.turbulence.contract import check_option

SIDE_PX = 256
MOST_FRAMES = 120  # of the footage that are used
FEWEST_FRAMES, FEWEST_CORNERS = 8, 20
NODE_PX = 2.0  # between the nodes of a field
SMOOTHING = 10.0  # of the thin-plate spline: what meets held-out corners of real footage best
LONGEST_SIDE = 768  # pixels of the smaller side up to which footage is enlarged, at most twice
MOST_CORNERS, CORNER_DISTANCE_PX = 1500, 5
CORNER_QUALITY = 0.02  # of that of the best corner
LARGEST_RETURN_ERROR_PX = 0.6  # of a corner tracked forth and back
LEAST_FRAMES_SHARE = 0.9  # share of the frames in which a corner must be found
LARGEST_MOTION_RATIO = 3.0  # times the median motion; what moves more is a car or a leaf


@dataclass(frozen=True)
class UnitRmsDisplacement:
    """Displacement (x, y), of 1 px rms along an axis, on nodes over `height_px` x `width_px`.

    Between nodes and between frames lies a cubic spline, beyond the ends their mirror image: in
    time the footage is played to and fro.
    """

    nodes: Float[Tensor, "frames xy=2 rows columns"]
    height_px: float
    width_px: float

    def sample(
        self, time: Float[NDArray, " time"], y: Float[NDArray, " y"], x: Float[NDArray, " x"]
    ) -> Float[Tensor, "time xy=2 y x"]:
        """Return the displacement at `time`, in frames of the footage, at every (y, x)."""
        frames, _, rows, columns = self.nodes.shape
        when = _spline_weights(frames, time)
        down = _spline_weights(rows, y * (rows - 1) / self.height_px)
        across = _spline_weights(columns, x * (columns - 1) / self.width_px)
        return down @ torch.einsum("tk,kcij->tcij", when, self.nodes) @ across.T


@lru_cache(maxsize=4)
def track_displacement_fields(footage: Path) -> UnitRmsDisplacement:
    """Return the displacement fields of `footage`, a video or a folder of frames.

    Raises ValueError where there is not one video, it is too short, or too few of its corners stay.
    """
    videos = find_videos(footage, "turbulence.footage")
    allowed = "one video or one folder of frames"
    check_option(len(videos) == 1, "footage", allowed, len(videos))
    frames = list(islice(videos[0].read(0, videos[0].count), MOST_FRAMES))
    allowed = f"footage of {FEWEST_FRAMES} frames or more"
    check_option(len(frames) >= FEWEST_FRAMES, "footage", allowed, len(frames))
    displacement, at, tried = _track_corners(frames)
    allowed = f"a still scene of which {FEWEST_CORNERS} corners or more can be followed"
    got = f"{len(at)} of {tried} in {footage}"
    check_option(len(at) >= FEWEST_CORNERS, "footage", allowed, got)
    return fit_displacement_field(displacement, at)


def fit_displacement_field(
    displacement: Float[NDArray, "frames corners 2"], at: Float[NDArray, "corners 2"]
) -> UnitRmsDisplacement:
    """Return fields over the rectangle that the corners at places `at` (x, y) fill."""
    low, high = at.min(0), at.max(0)
    width, height = (high - low).tolist()
    y = np.linspace(0, height, round(height / NODE_PX) + 1)
    x = np.linspace(0, width, round(width / NODE_PX) + 1)
    places = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    values = displacement.transpose(1, 0, 2).reshape(len(at), -1)
    joined = RBFInterpolator(at - low, values, smoothing=SMOOTHING)(places)
    joined = joined.reshape(len(y), len(x), len(displacement), 2).transpose(2, 3, 0, 1)
    nodes = torch.from_numpy(joined / np.sqrt(np.square(joined).mean()))
    return UnitRmsDisplacement(nodes.float().contiguous(), height, width)


def _spline_weights(knots: int, at: Float[NDArray, " at"]) -> Float[Tensor, "at knots"]:
    """Return the weight of knots 0, 1, ... in a cubic spline at `at`, mirrored beyond its ends."""
    last = knots - 1
    folded = last - np.abs(at % (2 * last) - last)
    weights = CubicSpline(np.arange(knots), np.eye(knots), bc_type="clamped")(folded)
    return torch.from_numpy(weights).float()


def _track_corners(
    footage: Sequence[NDArray],
) -> tuple[Float[np.ndarray, "frames corners 2"], Float[np.ndarray, "corners 2"], int]:
    """Return each corner's displacement (x, y) from its mean place, its place, and how many corners
    were tried, in pixels of a frame whose smaller side is SIDE_PX.

    Corners of the mean frame (Shi & Tomasi 1994) are tracked into every frame and back (pyramidal
    Lucas-Kanade, Bouguet 2001); gaps are filled linearly in time.  May find no corner at all.
    """
    scale = min(LONGEST_SIDE / min(footage[0].shape), 2.0)
    kind = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    frames = [cv2.resize(f, None, fx=scale, fy=scale, interpolation=kind) for f in footage]
    mean = np.clip(np.mean(frames, 0), 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(mean, MOST_CORNERS, CORNER_QUALITY, CORNER_DISTANCE_PX)
    if corners is None:
        return np.zeros((len(frames), 0, 2)), np.zeros((0, 2)), 0
    displacement = np.stack([_track_frame(mean, frame, corners) for frame in frames])
    kept = np.isfinite(displacement[..., 0]).mean(0) > LEAST_FRAMES_SHARE
    displacement, times = displacement[:, kept].copy(), np.arange(len(frames))
    for path in displacement.reshape(len(frames), -1).T:
        lost = np.isnan(path)
        path[lost] = np.interp(times[lost], times[~lost], path[~lost])
    displacement -= displacement.mean(0)
    spread = np.sqrt((displacement**2).mean((0, 2)))
    steady = spread < LARGEST_MOTION_RATIO * np.median(spread) if len(spread) else kept[:0]
    unit = SIDE_PX / (scale * min(footage[0].shape))
    return displacement[:, steady] * unit, corners[kept, 0][steady] * unit, len(corners)


def _track_frame(mean: NDArray, frame: NDArray, corners: NDArray) -> NDArray:
    """Return how far the corners of `mean` have moved in `frame`, NaN for lost ones."""
    flow = partial(cv2.calcOpticalFlowPyrLK, winSize=(21, 21), maxLevel=2)
    there, followed, _ = flow(mean, frame, corners, None)
    back, again, _ = flow(frame, mean, there, None)
    stray = np.abs(back - corners).max((1, 2))
    good = (followed[:, 0] > 0) & (again[:, 0] > 0) & (stray < LARGEST_RETURN_ERROR_PX)
    return np.where(good[:, None], (there - corners)[:, 0], np.nan)
