"""The covariance of tilt over distance and over time, from tracked points.

It is taken between two estimates with independent noise (point_tracking.py): what is left at
distance 0 is motion.  Over distance it is described by a sum of Gaussians of many lengths with
weights >= 0, which also says what lies between the points.  What a window averages away is added in
their widths; covariance over less than a window, the error of tracking, has a Gaussian of its own.
Sums are kept by frame and square of the frame, so that both can be resampled.  Lengths in pixels.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import nnls

from src.recordings.turbulence_measurement.point_tracking import SPREAD, PointTracks

CELLS = 4  # a side: squares of the frame
MIN_LENGTH_PX = 2.5  # the shortest Gaussian that is taken for tilt
DISTANCE_CLASSES = 22  # of distances
MIN_PAIRS = 30  # pairs that make a class
MAX_LAG = 120  # frames
Distances = Float[np.ndarray, " distances"]


@dataclass(frozen=True)
class CovarianceSums:
    """Sums of `total` products and their `count`, (frames, squares, classes); `at` says what the
    classes are: distances in pixels, or lags in frames."""

    at: Float[np.ndarray, " classes"]
    total: Float[np.ndarray, "frames squares classes"]
    count: Float[np.ndarray, "frames squares classes"]

    def weighted_mean_and_count(
        self, frames: Float[np.ndarray, " frames"], squares: Float[np.ndarray, " squares"]
    ) -> tuple[Float[np.ndarray, " classes"], Float[np.ndarray, " classes"]]:
        """Return the mean product of every class and the count, for these weights."""
        both = (self.total, self.count)
        total, count = (np.einsum("t,tsk,s->k", frames, sums, squares) for sums in both)
        return total / np.maximum(count, 1), count


@dataclass(frozen=True)
class TiltStatistics:
    """`power_px2` along one axis; `half_length_px`, where the covariance is half of it, inf beyond
    the frame; `whole_view_share`, the share that moves the whole square view; `decay_frames`, the
    time to 1/e, inf beyond the video; `left_share`, the share of the power that is left after the
    mean of the video was taken off; `correlation` over distance (nan: too few pairs),
    `lag_correlation`; `fitted_correlation`: that over the model's `fitted_distance_px`.
    """

    power_px2: float
    half_length_px: float
    whole_view_share: float
    decay_frames: float
    left_share: float
    correlation: Distances
    lag_correlation: Float[np.ndarray, " lags"]
    fitted_correlation: Float[np.ndarray, " k"]


def frame_squares(tracks: PointTracks, size: tuple[int, int]) -> Int[np.ndarray, " points"]:
    """Return the number of the square of the frame, of CELLS x CELLS, that every point is in."""
    column, row = (tracks.place * CELLS / size[::-1]).astype(int).clip(0, CELLS - 1).T
    return row * CELLS + column


def centre_displacements(tracks: PointTracks) -> Float[np.ndarray, "2 frames points 2"]:
    """Return the displacements from every point's mean; 0 where it was not seen."""
    seen = tracks.seen[None, ..., None]
    mean = tracks.moved.sum(1) / np.maximum(seen.sum(1), 1)
    return np.where(seen, tracks.moved - mean[:, None], 0)


def tilt_variance_per_axis(tracks: PointTracks) -> Float[np.ndarray, " points"]:
    """Return the mean square displacement of every point along one axis, free of noise."""
    a, b = centre_displacements(tracks)
    return (a * b).sum((0, 2)) / (2 * tracks.seen.sum(0))


def sum_over_distance(tracks: PointTracks, size: tuple[int, int]) -> CovarianceSums:
    """Sum the products of displacement, mean of both axes, of all pairs of points."""
    a, b = centre_displacements(tracks)
    first, second = np.triu_indices(len(tracks.place))
    apart = np.hypot(*(tracks.place[first] - tracks.place[second]).T)
    edges = np.concatenate([[-0.5, 0.5], np.geomspace(2, 1.45 * min(size), DISTANCE_CLASSES - 1)])
    bins = np.digitize(apart, edges) - 1
    inside = bins < DISTANCE_CLASSES
    first, second, bins = first[inside], second[inside], bins[inside]
    place = frame_squares(tracks, size)[first] * DISTANCE_CLASSES + bins
    shape, length = (CELLS**2, DISTANCE_CLASSES), CELLS**2 * DISTANCE_CLASSES
    total, count = [], []
    for ours, theirs, seen in zip(a, b, tracks.seen.astype(float), strict=True):
        product = ours @ theirs.T
        product = (product + product.T) / 4
        total.append(np.bincount(place, product[first, second], length).reshape(shape))
        count.append(np.bincount(place, seen[first] * seen[second], length).reshape(shape))
    many = np.bincount(bins, minlength=DISTANCE_CLASSES)
    mean = np.bincount(bins, apart[inside], DISTANCE_CLASSES) / np.maximum(many, 1)
    mean = np.where(many > 0, mean, (edges[1:] + edges[:-1]) / 2)
    return CovarianceSums(mean, np.stack(total), np.stack(count))


def sum_autocovariance(tracks: PointTracks, size: tuple[int, int]) -> CovarianceSums:
    """Sum the products of displacement of every point with its own at lags of 0, 1, ... frames."""
    a, b = centre_displacements(tracks)
    frames = len(tracks.seen)
    lags = np.arange(min(frames // 2, MAX_LAG))
    belongs = np.eye(CELLS**2)[frame_squares(tracks, size)]
    total, count = np.zeros((2, frames, CELLS**2, len(lags)))
    for lag in lags:
        kept = frames - lag
        product = a[:kept] * b[lag:] + b[:kept] * a[lag:]
        total[:kept, :, lag] = product.sum(-1) / 4 @ belongs
        count[:kept, :, lag] = (tracks.seen[:kept] & tracks.seen[lag:]) @ belongs
    return CovarianceSums(lags.astype(float), total, count)


class CovarianceModel:
    """A sum of Gaussians of `lengths` for the covariance over distance in a frame of `size`."""

    def __init__(self, distance: np.ndarray, window_variance_px2: float, size: tuple[int, int]):
        self.distance, self.window, self.side = distance, window_variance_px2, min(size)
        self.lengths = np.append(np.geomspace(MIN_LENGTH_PX, self.side, 30), 100 * self.side)
        self.fitted_distance_px = np.geomspace(0.25, 1.4 * self.side, 1200)
        points = np.random.default_rng(0).uniform(0, self.side, (2, 20000, 2))
        # Distances of pairs in a square view, ascending: np.interp is faster for them.
        self.pairs = np.sort(np.hypot(*(points[0] - points[1]).T))
        self._near = int(np.searchsorted(self.pairs, 4 * SPREAD))

    def describe_tilt(
        self, product: Distances, count: Distances, lags: Float[np.ndarray, " lags"], frames: int
    ) -> TiltStatistics:
        """Describe the tilt by its mean product and its count over distance, and its mean product
        over lags, in a film of so many `frames`."""
        weights = self._fit(product, count)
        through = self._gaussians(np.zeros(1), self.window)[0] @ weights
        lag_correlation, left = _correlation_over_lags(lags, through, frames)
        power = weights.sum()
        curve = self._gaussians(self.fitted_distance_px, 0.0) @ weights / max(power, 1e-12)
        correlation = product / max(power, 1e-12)
        fitted = np.interp(self.distance, self.fitted_distance_px, curve)
        filled_correlation = np.where(count > MIN_PAIRS, correlation, fitted)
        # Beyond the shortest distances what was measured is taken as it is, negative values too.
        near = np.interp(self.pairs[: self._near], self.fitted_distance_px, curve)
        far = np.interp(self.pairs[self._near :], self.distance[1:], filled_correlation[1:])
        uniform = float(np.concatenate([near, far]).mean())
        # A film's own mean was taken off: 1 - left of the power, at every distance alike.
        return TiltStatistics(
            power_px2=float(power / left),
            half_length_px=float(find_first_fall(self.fitted_distance_px, curve, 0.5)),
            whole_view_share=float(np.clip(uniform, 0, 1)),
            decay_frames=float(find_decay_lag(lag_correlation)),
            left_share=left,
            correlation=np.where(count > MIN_PAIRS, correlation, np.nan),
            lag_correlation=lag_correlation,
            fitted_correlation=curve,
        )

    def _gaussians(self, distance: np.ndarray, window_variance_px2: float) -> np.ndarray:
        wide = self.lengths**2 + 2 * window_variance_px2
        return self.lengths**2 / wide * np.exp(-(distance[:, None] ** 2) / (2 * wide))

    def _fit(self, product: np.ndarray, count: np.ndarray) -> np.ndarray:
        use = count > MIN_PAIRS
        near = self.distance[use]
        error = np.exp(-(near[:, None] ** 2) / (2 * SPREAD**2))
        columns = np.hstack([self._gaussians(near, self.window), error])
        trust = np.sqrt(np.minimum(count[use], 5 * count[0]) / count[0])
        return nnls(columns * trust[:, None], product[use] * trust)[0][:-1]


def _correlation_over_lags(
    product: np.ndarray, power: float, frames: int
) -> tuple[np.ndarray, float]:
    """Return the correlation over lags, and the share of power left after taking off the mean of
    the frames: measured = (true - m) / (1 - m), m the mean correlation of all their pairs.  What
    lies beyond the first zero of `true` counts as 0.
    """
    measured = np.minimum(product / max(power, 1e-12), 1.0)
    measured[0] = 1.0  # what is more is the error of tracking
    share = (1 - np.arange(1, len(product)) / frames) * 2 / frames
    lost, before = 0.0, -1.0
    for _ in range(50):
        if lost == before:
            break
        true = lost + (1 - lost) * measured
        positive = np.logical_and.accumulate(true > 0)
        lost, before = min(1 / frames + float(share @ (true * positive)[1:]), 0.9), lost
    return lost + (1 - lost) * measured, 1 - lost


def find_decay_lag(correlation: Float[np.ndarray, " lags"]) -> float:
    """Return the lag at which a correlation over lags first falls to 1/e, inf if nowhere: joined by
    exponentials, as it falls within a frame or two."""
    logarithms = np.log(np.maximum(correlation, 1e-6))
    return find_first_fall(np.arange(len(correlation)), logarithms, -1.0)


def find_first_fall(at: np.ndarray, curve: np.ndarray, level: float) -> float:
    """Return where a curve first falls to `level`, joined linearly; inf if nowhere."""
    below = np.flatnonzero(curve <= level)
    if not below.size:
        return np.inf
    k = int(below[0])
    if k == 0:
        return float(at[0])
    high, low = curve[k - 1], curve[k]
    return float(at[k - 1] + (at[k] - at[k - 1]) * (high - level) / (high - low))
