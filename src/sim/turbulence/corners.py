"""How the air moves the picture of a still scene: its corners, followed through the footage."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

LONGEST_SIDE = 768  # pixels of the smaller side up to which footage is enlarged, at most twice
CORNERS, QUALITY, APART = 1500, 0.02, 5  # at most; share of the best one's; pixels between two
WINDOW = {"winSize": (21, 21), "maxLevel": 2}
RETURNED = 0.6  # pixels within which a corner followed forth and back must return
SEEN = 0.9  # share of the frames in which a corner must be found
CALM = 3.0  # times the median motion; what moves more is no air: a car, a leaf


def track(
    footage: Sequence[NDArray], side_px: int
) -> tuple[Float[np.ndarray, "frames corners 2"], Float[np.ndarray, "corners 2"], int]:
    """Return each corner's displacement (x, y) from its mean place, its place, and how many corners
    were tried, in pixels of a frame whose smaller side is `side_px`.

    Corners of the mean frame (Shi & Tomasi 1994) are followed into every frame and back (pyramidal
    Lucas-Kanade, Bouguet 2001).  Left out is what does not return, is missing in more than one
    frame of ten or moves three times as much as the rest; gaps are filled linearly in time.
    `footage`: grey frames, uint8 (h, w).  May find no corner at all: footage of a moving camera.
    """
    scale = min(LONGEST_SIDE / min(footage[0].shape), 2.0)
    kind = cv2.INTER_CUBIC if scale > 1 else cv2.INTER_AREA
    frames = [cv2.resize(f, None, fx=scale, fy=scale, interpolation=kind) for f in footage]
    mean = np.clip(np.mean(frames, 0), 0, 255).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(mean, CORNERS, QUALITY, APART)
    if corners is None:
        return np.zeros((len(frames), 0, 2)), np.zeros((0, 2)), 0
    moved = np.stack([_follow(mean, frame, corners) for frame in frames])
    kept = np.isfinite(moved[..., 0]).mean(0) > SEEN
    moved = _filled(moved[:, kept])
    moved = moved - moved.mean(0)
    spread = np.sqrt((moved**2).mean((0, 2)))
    calm = spread < CALM * np.median(spread) if len(spread) else kept[:0]
    unit = side_px / (scale * min(footage[0].shape))
    return moved[:, calm] * unit, corners[kept, 0][calm] * unit, len(corners)


def _follow(mean: NDArray, frame: NDArray, corners: NDArray) -> NDArray:
    """Return how far the corners of `mean` have moved in `frame`, NaN for those that got lost."""
    there, followed, _ = cv2.calcOpticalFlowPyrLK(mean, frame, corners, None, **WINDOW)
    back, again, _ = cv2.calcOpticalFlowPyrLK(frame, mean, there, None, **WINDOW)
    stray = np.abs(back - corners).max((1, 2))
    good = (followed[:, 0] > 0) & (again[:, 0] > 0) & (stray < RETURNED)
    return np.where(good[:, None], (there - corners)[:, 0], np.nan)


def _filled(moved: NDArray) -> NDArray:
    """Fill NaN in (frames, corners, 2) linearly in time."""
    times, filled = np.arange(len(moved)), moved.copy()
    for path in filled.reshape(len(moved), -1).T:
        finite = np.isfinite(path)
        path[~finite] = np.interp(times[~finite], times[finite], path[finite])
    return filled
