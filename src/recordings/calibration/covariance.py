"""The covariance of tilt over distance and over time, from points that were followed.

It is taken between two estimates with independent noise (following.py), so that what is left at
distance 0 is motion.  Over distance it is described by a sum of Gaussians of many lengths with
weights >= 0, which also says what lies between the points.  What a window averages away is added in
their widths; covariance over less than a window, the error of following, has a Gaussian of its own.
Sums are kept by frame and square of the frame, so that both can be resampled.  Lengths in pixels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from src.recordings.calibration.following import SPREAD, Tracks

CELLS = 4  # a side: squares of the frame
SHORTEST = 2.5  # the shortest Gaussian that is taken for tilt
CLASSES = 22  # of distances
ENOUGH = 30  # pairs that make a class
LONGEST_LAG = 120  # frames


@dataclass(frozen=True)
class Products:
    """Sums of `total` products and their `count`, (frames, squares, classes); `at` says what the
    classes are: distances in pixels, or lags in frames."""

    at: Float[np.ndarray, " classes"]
    total: Float[np.ndarray, "frames squares classes"]
    count: Float[np.ndarray, "frames squares classes"]

    def mean(
        self,
        frames: Float[np.ndarray, " frames"] | None = None,
        squares: Float[np.ndarray, " squares"] | None = None,
    ) -> tuple[Float[np.ndarray, " classes"], Float[np.ndarray, " classes"]]:
        """Return the mean product of every class and the count, frames and squares weighed."""
        frames = np.ones(self.total.shape[0]) if frames is None else frames
        squares = np.ones(self.total.shape[1]) if squares is None else squares
        both = (self.total, self.count)
        total, count = (np.einsum("t,tsk,s->k", frames, sums, squares) for sums in both)
        return total / np.maximum(count, 1), count


@dataclass(frozen=True)
class Tilt:
    """Its `power` along one axis in px^2; `half_px`, where the covariance is half of it, inf beyond
    the frame; `whole`, the share that moves the whole square view; `decay` to 1/e in frames, inf
    beyond the film; `correlation` over distance (nan: too few pairs), `memory` over lag; `fitted`
    over the model's `fitted_px`.
    """

    power: float
    half_px: float
    whole: float
    decay: float
    correlation: Float[np.ndarray, " distances"]
    memory: Float[np.ndarray, " lags"]
    fitted: Float[np.ndarray, " k"]


def squares(tracks: Tracks, size: tuple[int, int]) -> Int[np.ndarray, " points"]:
    """Return the number of the square of the frame, of CELLS x CELLS, that every point is in."""
    column, row = (tracks.place * CELLS / size[::-1]).astype(int).clip(0, CELLS - 1).T
    return row * CELLS + column


def centred(tracks: Tracks) -> Float[np.ndarray, "2 frames points 2"]:
    """Return the displacements from every point's mean; 0 where it was not seen."""
    seen = tracks.seen[None, ..., None]
    mean = tracks.moved.sum(1) / np.maximum(seen.sum(1), 1)
    return np.where(seen, tracks.moved - mean[:, None], 0)


def over_distance(tracks: Tracks, size: tuple[int, int]) -> Products:
    """Sum the products of displacement, mean of both axes, of all pairs of points."""
    a, b = centred(tracks)
    first, second = np.triu_indices(len(tracks.place))
    apart = np.hypot(*(tracks.place[first] - tracks.place[second]).T)
    edges = np.concatenate([[-0.5, 0.5], np.geomspace(2, 1.45 * min(size), CLASSES - 1)])
    bins = np.digitize(apart, edges) - 1
    inside = bins < CLASSES
    first, second, bins = first[inside], second[inside], bins[inside]
    place = squares(tracks, size)[first] * CLASSES + bins
    shape, length = (CELLS**2, CLASSES), CELLS**2 * CLASSES
    total, count = [], []
    for ours, theirs, seen in zip(a, b, tracks.seen.astype(float), strict=True):
        product = ours @ theirs.T
        product = (product + product.T) / 4
        total.append(np.bincount(place, product[first, second], length).reshape(shape))
        count.append(np.bincount(place, seen[first] * seen[second], length).reshape(shape))
    many = np.bincount(bins, minlength=CLASSES)
    mean = np.bincount(bins, apart[inside], CLASSES) / np.maximum(many, 1)
    mean = np.where(many > 0, mean, (edges[1:] + edges[:-1]) / 2)
    return Products(mean, np.stack(total), np.stack(count))


def over_time(tracks: Tracks, size: tuple[int, int]) -> Products:
    """Sum the products of displacement of every point with its own at lags of 0, 1, ... frames."""
    a, b = centred(tracks)
    frames = len(tracks.seen)
    lags = np.arange(min(frames // 2, LONGEST_LAG))
    belongs = np.eye(CELLS**2)[squares(tracks, size)]
    total, count = np.zeros((2, frames, CELLS**2, len(lags)))
    for lag in lags:
        kept = frames - lag
        product = a[:kept] * b[lag:] + b[:kept] * a[lag:]
        total[:kept, :, lag] = product.sum(-1) / 4 @ belongs
        count[:kept, :, lag] = (tracks.seen[:kept] & tracks.seen[lag:]) @ belongs
    return Products(lags.astype(float), total, count)


class Model:
    """A sum of Gaussians of `lengths` for the covariance over distance in a frame of `size`."""

    def __init__(self, distance: np.ndarray, window_px2: float, size: tuple[int, int]):
        self.distance, self.window, self.side = distance, window_px2, min(size)
        self.lengths = np.append(np.geomspace(SHORTEST, self.side, 30), 100 * self.side)
        self.fitted_px = np.geomspace(0.25, 1.4 * self.side, 1200)
        points = np.random.default_rng(0).uniform(0, self.side, (2, 20000, 2))
        self.pairs = np.hypot(*(points[0] - points[1]).T)  # of a square view

    def tilt(
        self,
        product: Float[np.ndarray, " distances"],
        count: Float[np.ndarray, " distances"],
        lags: Float[np.ndarray, " lags"],
        frames: int,
    ) -> Tilt:
        """Describe the tilt by its mean product and its count over distance, and its mean product
        over lags, in a film of so many `frames`."""
        weights = self._fit(product, count)
        through = self._gaussians(np.zeros(1), self.window)[0] @ weights
        memory, kept = _memory(lags, through, frames)
        power = weights.sum()
        curve = self._gaussians(self.fitted_px, 0.0) @ weights / max(power, 1e-12)
        correlation = product / max(power, 1e-12)
        fitted = np.interp(self.distance, self.fitted_px, curve)
        joined = np.where(count > ENOUGH, correlation, fitted)
        # Beyond the shortest distances what was measured is taken as it is, negative values too.
        far = np.interp(self.pairs, self.distance[1:], joined[1:])
        near = np.interp(self.pairs, self.fitted_px, curve)
        whole = float(np.where(self.pairs < 4 * SPREAD, near, far).mean())
        # A film's own mean was taken off: 1 - kept of the power, at every distance alike.
        return Tilt(
            power=float(power / kept),
            half_px=float(crossing(self.fitted_px, curve, 0.5)),
            whole=float(np.clip(whole, 0, 1)),
            decay=float(crossing(np.arange(len(lags)), memory, np.exp(-1))),
            correlation=np.where(count > ENOUGH, correlation, np.nan),
            memory=memory,
            fitted=curve,
        )

    def _gaussians(self, distance: np.ndarray, window_px2: float) -> np.ndarray:
        wide = self.lengths**2 + 2 * window_px2
        return self.lengths**2 / wide * np.exp(-(distance[:, None] ** 2) / (2 * wide))

    def _fit(self, product: np.ndarray, count: np.ndarray) -> np.ndarray:
        use = count > ENOUGH
        near = self.distance[use]
        error = np.exp(-(near[:, None] ** 2) / (2 * SPREAD**2))
        columns = np.hstack([self._gaussians(near, self.window), error])
        trust = np.sqrt(np.minimum(count[use], 5 * count[0]) / count[0])
        return nnls(columns * trust[:, None], product[use] * trust)[0][:-1]


def _memory(product: np.ndarray, power: float, frames: int) -> tuple[np.ndarray, float]:
    """Return the correlation over lags, and the share of power left after taking off the mean.

    Taking off the mean of T frames takes off m, the mean correlation of all their pairs:
    measured = (true - m) / (1 - m).  Solved for true; what lies beyond its first zero counts as 0.
    """
    measured = np.minimum(product / max(power, 1e-12), 1.0)
    measured[0] = 1.0  # what is more is the error of following
    share = (1 - np.arange(1, len(product)) / frames) * 2 / frames
    lost = 0.0
    for _ in range(50):
        true = lost + (1 - lost) * measured
        positive = np.logical_and.accumulate(true > 0)
        lost = min(1 / frames + float(share @ (true * positive)[1:]), 0.9)
    return lost + (1 - lost) * measured, 1 - lost


def crossing(at: np.ndarray, curve: np.ndarray, level: float) -> float:
    """Return where a curve first falls to `level`, joined linearly; inf if nowhere."""
    below = np.flatnonzero(curve <= level)
    if not below.size:
        return np.inf
    k = int(below[0])
    if k == 0:
        return float(at[0])
    high, low = curve[k - 1], curve[k]
    return float(at[k - 1] + (at[k] - at[k - 1]) * (high - level) / (high - low))
