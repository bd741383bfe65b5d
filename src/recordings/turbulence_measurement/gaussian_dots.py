"""A 2-D Gaussian fitted to every dot of every frame by least squares (Levenberg-Marquardt).

    I(x, y) = A exp(-(x - cx)^2 / (2 sx^2) - (y - cy)^2 / (2 sy^2)) + B     (the paper's supplement)

Dark dots have A < 0.  Positions are pixels, (0, 0) the centre of the top left one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

XTOL = 1e-6  # relative change of the parameters after which a fit is done
MIN_EXPLAINED = 0.5  # of the patch's variance, or it is no dot
LOG_SIGMA = (-2.5, 5.0)  # allowed log of a spread in pixels while fitting
MIN_SIGMA = 0.3  # pixels


@dataclass(frozen=True)
class GaussianFits:
    """Dots in frames, NaN where a fit failed: `centres` (x, y); `blur`, the mean spread
    (sx + sy) / 2 in pixels; `flux`, the light above (dark dots: missing below) the background,
    2 pi |A| sx sy."""

    centres: Float[np.ndarray, "frames dots 2"]
    blur: Float[np.ndarray, "frames dots"]
    flux: Float[np.ndarray, "frames dots"]

    @property
    def is_fitted(self) -> Bool[np.ndarray, "frames dots"]:
        return np.isfinite(self.blur)


def fit_gaussians(
    frames: Float[np.ndarray, "frames h w"], centres: Float[np.ndarray, "dots 2"], radius: int
) -> GaussianFits:
    """Fit the dots near `centres` (x, y), each within the square of `radius` pixels around it.

    A fit that leaves its square, explains less than half of the variance or meets what is not
    finite is NaN.  Raises ValueError for a centre off the picture or a radius below 2.
    """
    height, width = frames.shape[1:]
    if radius < 2:
        raise ValueError(f"dots.fit_radius_px must be >= 2 pixels, got {radius}")
    if ((centres < 0) | (centres > [width - 1, height - 1])).any():
        raise ValueError(f"dots must lie in the {width}x{height} picture, got {centres.tolist()}")
    results = np.full((6, len(frames), len(centres)), np.nan)
    for dot, centre in enumerate(np.round(centres).astype(int)):
        left, top = np.maximum(centre - radius, 0)
        right, bottom = np.minimum(centre + radius + 1, [width, height])
        y, x = np.mgrid[top:bottom, left:right].reshape(2, -1).astype(np.float64)
        for number, frame in enumerate(frames):
            patch = frame[top:bottom, left:right].ravel().astype(np.float64)
            results[:, number, dot] = _fit_patch(patch, x, y)
    x, y, sigma_x, sigma_y, amplitude, _ = results
    flux = 2 * np.pi * np.abs(amplitude) * sigma_x * sigma_y
    return GaussianFits(np.stack([x, y], axis=-1), (sigma_x + sigma_y) / 2, flux)


def _fit_patch(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return cx, cy, sx, sy, A, B of a patch, flat as `x` and `y` are, or NaN."""
    failed = np.full(6, np.nan)
    if not np.isfinite(values).all() or values.std() == 0:
        return failed
    start = _initial_guess(values, x, y)
    fit = least_squares(_residuals, start, method="lm", xtol=XTOL, args=(values, x, y))
    cx, cy, *log_sigma, amplitude, background = fit.x
    sigma = np.exp(np.clip(log_sigma, *LOG_SIGMA))
    max_sigma = max(np.ptp(x), np.ptp(y)) / 2
    inside = x.min() < cx < x.max() and y.min() < cy < y.max()
    explains = 2 * fit.cost < (1 - MIN_EXPLAINED) * values.var() * values.size
    if not (inside and explains and sigma.max() < max_sigma and sigma.min() > MIN_SIGMA):
        return failed
    return np.array([cx, cy, *sigma, amplitude, background])


def _initial_guess(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Moments of what stands out of the rim's median: cx, cy, log sx, log sy, A, B."""
    rim = (x == x.min()) | (x == x.max()) | (y == y.min()) | (y == y.max())
    background = np.median(values[rim])
    rise = values - background
    amplitude = rise[np.abs(rise).argmax()]
    weight = np.clip(rise / amplitude - 0.3, 0, None)
    weight /= weight.sum()
    cx, cy = weight @ x, weight @ y
    spread = weight @ ((x - cx) ** 2 + (y - cy) ** 2) / 2
    log_sigma = np.log(max(1.5 * np.sqrt(spread), 0.5))
    return np.array([cx, cy, log_sigma, log_sigma, amplitude, background])


def _residuals(
    parameters: np.ndarray, values: np.ndarray, x: np.ndarray, y: np.ndarray
) -> np.ndarray:
    cx, cy, *log_sigma, amplitude, background = parameters
    sigma_x, sigma_y = np.exp(np.clip(log_sigma, *LOG_SIGMA))
    bell = np.exp(-((x - cx) ** 2) / (2 * sigma_x**2) - (y - cy) ** 2 / (2 * sigma_y**2))
    return amplitude * bell + background - values
