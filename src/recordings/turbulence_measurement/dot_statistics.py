"""Turbulence statistics of a dot grid seen by several views (the paper's supplement).

Tilt is a dot's displacement from where it lies without turbulence, less how far the whole grid
moved between the two recordings (as a camera that was touched moves it), blur the mean spread of
its Gaussian, intensity its flux over the flux's mean in time.  Lengths are pixels of the pictures
given, times seconds.  Frames in which a fit failed are left out of every mean and counted.
"""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import pdist

from src.recordings.calibration.boards import Circles
from src.recordings.calibration.view_alignment import repair_picture
from src.recordings.turbulence_measurement.gaussian_dots import GaussianFits
from src.recordings.turbulence_measurement.tilt_covariance import find_first_fall
from src.records.atomic import write_text
from src.records.results import format_csv


@dataclass(frozen=True)
class DotStatistics:
    """Tilt, blur and relative intensity with turbulence, `still_` ones without; NaN where a fit
    failed.  Dots are in order row by row; `centre_view`: the index of the centre view;
    `mean_displacement`: of a view's grid between the recordings, in pixels, not part of the tilt.
    """

    fps: float
    centre_view: int
    tilt: Float[np.ndarray, "views frames dots 2"]
    blur: Float[np.ndarray, "views frames dots"]
    relative_intensity: Float[np.ndarray, "views frames dots"]
    mean_displacement: Float[np.ndarray, "views 2"]
    still_tilt: Float[np.ndarray, "views still dots 2"]
    still_blur: Float[np.ndarray, "views dots"]
    still_relative_intensity: Float[np.ndarray, "views still dots"]

    @property
    def failed(self) -> Int[np.ndarray, "views dots"]:
        return np.isnan(self.blur).sum(1)

    @property
    def blur_over_still(self) -> Float[np.ndarray, "views dots"]:
        return _mean(self.blur, 1) / self.still_blur

    @property
    def scintillation(self) -> Float[np.ndarray, "views dots"]:
        return scintillation_index(self.relative_intensity)

    @property
    def still_scintillation(self) -> Float[np.ndarray, "views dots"]:  # of noise and fit alone
        return scintillation_index(self.still_relative_intensity)

    @property
    def lags_s(self) -> Float[np.ndarray, " lags"]:
        """Lags of `middle_dot_autocorrelation`, up to a quarter of the recording."""
        return np.arange(max(self.tilt.shape[1] // 4, 2)) / self.fps

    @property
    def middle_dot_autocorrelation(self) -> Float[np.ndarray, " lags"]:
        """Of the tilt of the middle dot of the centre view."""
        return autocorrelate(self.tilt[self.centre_view, :, self.middle_dot], len(self.lags_s))

    @property
    def centre_view_correlation(self) -> Float[np.ndarray, "dots dots"]:
        """Correlation of tilt between the dots of the centre view."""
        return tilt_correlation(self.tilt[self.centre_view])

    @property
    def tilt_correlation_across_views(self) -> Float[np.ndarray, "views views"]:
        """Correlation of tilt between the views, of the middle dot."""
        return tilt_correlation(self.tilt[:, :, self.middle_dot].swapaxes(0, 1))

    @property
    def middle_dot(self) -> int:
        return self.tilt.shape[2] // 2

    def summary(self) -> dict[str, float]:
        """Return the main numbers of the middle dot of the centre view."""
        dot, view = self.middle_dot, self.centre_view
        off = ~np.eye(len(self.tilt), dtype=bool)
        return {
            "frames": self.tilt.shape[1],
            "failed": int(self.failed.sum()),
            "tilt_rms_px": float(np.sqrt(_mean(self.tilt[view, :, dot] ** 2, None))),
            "still_tilt_rms_px": float(np.sqrt(_mean(self.still_tilt[view, :, dot] ** 2, None))),
            "mean_displacement_px": float(np.hypot(*self.mean_displacement[view])),
            "tilt_decay_s": float(decay_time_s(self.middle_dot_autocorrelation, self.fps)),
            "across_views": float(_mean(self.tilt_correlation_across_views[off], None)),
            "blur_over_still": float(self.blur_over_still[view, dot]),
            "scintillation": float(self.scintillation[view, dot]),
            "still_scintillation": float(self.still_scintillation[view, dot]),
        }


def compare_with_still(
    turbulent: Sequence[GaussianFits],
    still: Sequence[GaussianFits],
    *,
    fps: float,
    centre_view: int,
) -> DotStatistics:
    """Compare the fits of every view with those of the recording without turbulence.

    Raises ValueError for a dot that was never fitted: it has no reference.
    """
    reference = np.stack([_mean(fits.centres, 0) for fits in still])
    lost = ~np.isfinite(reference).all(-1) | ~np.stack(
        [fits.is_fitted.any(0) for fits in turbulent]
    )
    if lost.any():
        raise ValueError(
            f"turbulence: every dot must be fitted in some frame, got none for (view, dot)"
            f" {np.argwhere(lost).tolist()}; look at the picture, change dots.fit_radius_px"
        )
    displaced = np.stack([fits.centres for fits in turbulent]) - reference[:, None]
    # Dots count alike, however many frames of them failed.
    mean_displacement = _mean(displaced, 1).mean(1)
    return DotStatistics(
        fps=fps,
        centre_view=centre_view,
        tilt=displaced - mean_displacement[:, None, None],
        mean_displacement=mean_displacement,
        still_tilt=np.stack([fits.centres for fits in still]) - reference[:, None],
        blur=np.stack([fits.blur for fits in turbulent]),
        relative_intensity=np.stack([fits.flux / _mean(fits.flux, 0) for fits in turbulent]),
        still_blur=np.stack([_mean(fits.blur, 0) for fits in still]),
        still_relative_intensity=np.stack([fits.flux / _mean(fits.flux, 0) for fits in still]),
    )


def find_dots(
    picture: Float[np.ndarray, "h w"], rows: int, cols: int, dark: bool = True
) -> Float[np.ndarray, "dots 2"]:
    """Return the middle (x, y) of each dot, row by row, of an upright grid.

    Raises ValueError where the picture does not show exactly such a grid.
    """
    points = Circles(rows, cols, dark).find_points(repair_picture(picture))
    if points is None:
        raise ValueError(f"turbulence: a {rows}x{cols} grid of dots must be seen, got none")
    by_row = points[np.argsort(points[:, 1])].reshape(rows, cols, 2)
    return np.concatenate([row[np.argsort(row[:, 0])] for row in by_row])


def choose_fit_radius(centres: Float[np.ndarray, "dots 2"]) -> int:
    """Return a third of the least distance of two dots, in pixels: room for one that moves."""
    return max(3, round(pdist(centres).min() / 3))


def fit_background(
    picture: Float[np.ndarray, "h w"], centres: Float[np.ndarray, "dots 2"], radius: int
) -> Float[np.ndarray, "h w"]:
    """Return the light between dark dots, continued under them: a quadratic in x and y, fitted
    where no dot is within `radius` pixels; at least a twentieth of its largest value."""
    rows, cols = np.indices(picture.shape)
    y, x = (2 * axis / max(axis.max(), 1) - 1 for axis in (rows, cols))
    terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
    near = [np.hypot(cols - cx, rows - cy) <= radius for cx, cy in centres]
    between = ~np.any(near, axis=0)
    fitted = terms @ np.linalg.lstsq(terms[between], picture[between], rcond=None)[0]
    return np.maximum(fitted, 0.05 * fitted.max())


def autocorrelate(tilt: Float[np.ndarray, "frames 2"], lags: int) -> Float[np.ndarray, " lags"]:
    """Return (<ax(t) ax(t + lag)> / <ax^2> + the same of y) / 2 for lags of 0, 1, ... frames."""
    products = [_mean(tilt[: len(tilt) - lag] * tilt[lag:], 0) for lag in range(lags)]
    return (np.array(products) / _mean(tilt**2, 0)).mean(1)


def tilt_correlation(tilt: Float[np.ndarray, "frames k 2"]) -> Float[np.ndarray, "k k"]:
    """Return <a_i . a_j> / sqrt(<|a_i|^2> <|a_j|^2>) over the frames that have both."""
    both = np.isfinite(tilt).all(-1).astype(float)
    filled = np.nan_to_num(tilt)
    products = np.einsum("tic,tjc->ij", filled, filled)
    power = np.einsum("ti,tj->ij", (filled**2).sum(-1), both)
    return products / np.sqrt(power * power.T)


def scintillation_index(intensity: np.ndarray) -> Float[np.ndarray, "views dots"]:
    """Return <I^2> / <I>^2 - 1 over the frames of an intensity (views, frames, dots)."""
    return _mean(intensity**2, 1) / _mean(intensity, 1) ** 2 - 1


def decay_time_s(correlations: Float[np.ndarray, " lags"], fps: float) -> float:
    """Return the lag in seconds where a correlation first falls to 1/e; inf if nowhere."""
    return find_first_fall(np.arange(len(correlations)), correlations, np.exp(-1)) / fps


def write_view_dot_csv(
    statistics: DotStatistics, path: Path | str, positions: Sequence[tuple[int, int]]
) -> None:
    """Write one row per view and dot: failures, tilt, blur, blur over still, scintillation."""
    heads = ["row", "col", "dot", "frames", "failed", "tilt_x_rms_px", "tilt_y_rms_px"]
    heads += ["tilt_decay_s", "blur_px"]
    by_dot = ("blur_over_still", "scintillation", "still_scintillation")
    numbers, rows = [getattr(statistics, name) for name in by_dot], []
    for view, dot in np.ndindex(statistics.still_blur.shape):
        tilt = statistics.tilt[view, :, dot]
        decay = decay_time_s(autocorrelate(tilt, len(statistics.lags_s)), statistics.fps)
        counts = dot, len(tilt), int(statistics.failed[view, dot])
        moments = *np.sqrt(_mean(tilt**2, 0)), decay, _mean(statistics.blur[view, :, dot], 0)
        rows.append([*positions[view], *counts, *moments, *(part[view, dot] for part in numbers)])
    write_text(Path(path), format_csv([*heads, *by_dot], rows))


def _mean(values: np.ndarray, axis: int | None) -> np.ndarray:
    """The mean of what is finite; NaN, without a warning, where nothing is."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(np.nanmean(values, axis=axis))
