"""A camera that drifts, zooms or rolls slowly in front of a still scene, from tracked points.

In every frame a shift, a change of scale and a rotation of the view are fitted to the points.  Each
of these numbers has a trend over the film.  It is the camera's where it is SIGNIFICANT standard
errors or more (from the correlation of what it leaves) and where the trends of the points agree
with it: turbulence as slow as the film has trends that differ from point to point.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from src.recordings.turbulence_measurement.point_tracking import PointTracks
from src.recordings.turbulence_measurement.tilt_covariance import centre_displacements

# Standard errors.  Of 40 simulated films without drift 0 to 3 pass, decay up to film / 8.
SIGNIFICANT = 4.0
MIN_EXPLAINED = 0.5  # of the power of the points' trends
MAX_RELATIVE = 3.0  # times the median: points whose trend is further off move by themselves
NUMBERS = 4  # shift in x and y, scale, rotation
Trend = Float[np.ndarray, " 4"]


def remove_camera_drift(tracks: PointTracks) -> tuple[PointTracks, float]:
    """Return the tracks, 3 frames or more, without the drift of the camera, and the longest way in
    pixels that a point was moved by it over the film; 0.0 where none is found."""
    moved = centre_displacements(tracks).mean(0)
    time = np.linspace(-0.5, 0.5, len(moved))
    basis = _view_motions(tracks.place)
    own = np.einsum("t,tpk->pk", time, moved) / (time @ time)
    off = np.hypot(*(own - np.median(own, axis=0)).T)
    with_most = off <= MAX_RELATIVE * np.median(off)
    trend = _significant_trend(_fit_frames(moved, basis, tracks.seen & with_most), time)
    way = basis @ trend
    explained, left = ((part[with_most] ** 2).sum() for part in (way, own - way))
    if explained <= MIN_EXPLAINED * (explained + left):
        return tracks, 0.0
    drift = np.where(tracks.seen[..., None], time[:, None, None] * way, 0)
    return replace(tracks, moved=tracks.moved - drift), float(np.hypot(*way.T).max())


def _view_motions(place: Float[np.ndarray, "points 2"]) -> Float[np.ndarray, "points 2 4"]:
    """Return how every point moves in x and y as each of the NUMBERS grows by 1: those of scale and
    rotation move a typical point by 1 pixel."""
    from_centre = place - place.mean(0)
    x, y = (from_centre / np.sqrt((from_centre**2).sum(1).mean())).T
    one, none = np.ones_like(x), np.zeros_like(x)
    return np.stack([np.stack([one, none, x, -y], -1), np.stack([none, one, y, x], -1)], axis=1)


def _fit_frames(
    moved: Float[np.ndarray, "frames points 2"],
    basis: Float[np.ndarray, "points 2 4"],
    used: np.ndarray,
) -> Float[np.ndarray, "frames 4"]:
    """Return the NUMBERS of every frame by least squares; 0 in frames where too few are `used`."""
    found = np.zeros((len(moved), NUMBERS))
    for row, way, use in zip(found, moved, used, strict=True):
        if use.sum() >= NUMBERS:
            columns = basis[use].reshape(-1, NUMBERS)
            row[:] = np.linalg.lstsq(columns, way[use].ravel(), rcond=None)[0]
    return found


def _significant_trend(
    numbers: Float[np.ndarray, "frames 4"], time: Float[np.ndarray, " frames"]
) -> Trend:
    """Return the slopes over the film, 0 for those within SIGNIFICANT standard errors."""
    slope = time @ numbers / (time @ time)
    left = numbers - numbers.mean(0) - time[:, None] * slope
    error = np.sqrt([_long_run_variance(row) / (time @ time) for row in left.T])
    return np.where(np.abs(slope) > SIGNIFICANT * error, slope, 0)


def _long_run_variance(series: Float[np.ndarray, " frames"]) -> float:
    """Return the variance times the sum of the correlation over all lags up to its first zero."""
    frames = len(series)
    product = np.array([series[: frames - lag] @ series[lag:] for lag in range(frames // 2)])
    positive = np.logical_and.accumulate(product > 0)
    return float(2 * (product * positive).sum() - product[0]) / frames
