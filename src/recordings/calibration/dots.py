"""A 2-D Gaussian fitted to every dot of every frame, all fits at once (Levenberg-Marquardt).

    I(x, y) = A exp(-(x - cx)^2 / (2 sx^2) - (y - cy)^2 / (2 sy^2)) + B     (the paper's supplement)

Dark dots have A < 0.  Positions are pixels, (0, 0) the centre of the top left one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

STEPS = 40
SETTLED = 1e-5  # the change of a parameter after which its fit is done
CHUNK = 512  # fits at a time: 512 patches of 31x31 hold 25 MB of derivatives
EXPLAINED = 0.5  # of the patch's variance, or it is no dot


@dataclass(frozen=True)
class Fits:
    """Arrays (frames, dots), NaN where `ok` is False: centre, spread, amplitude and background."""

    x: Float[np.ndarray, "frames dots"]
    y: Float[np.ndarray, "frames dots"]
    sigma_x: Float[np.ndarray, "frames dots"]
    sigma_y: Float[np.ndarray, "frames dots"]
    amplitude: Float[np.ndarray, "frames dots"]
    background: Float[np.ndarray, "frames dots"]

    @property
    def ok(self) -> Bool[np.ndarray, "frames dots"]:
        return np.isfinite(self.x)

    @property
    def centres(self) -> Float[np.ndarray, "frames dots 2"]:
        return np.stack([self.x, self.y], axis=-1)

    @property
    def blur(self) -> Float[np.ndarray, "frames dots"]:
        """The mean spread (sx + sy) / 2 in pixels."""
        return (self.sigma_x + self.sigma_y) / 2

    @property
    def flux(self) -> Float[np.ndarray, "frames dots"]:
        """The light of the dot above (dark dots: missing below) the background, 2 pi |A| sx sy."""
        return 2 * np.pi * np.abs(self.amplitude) * self.sigma_x * self.sigma_y


def fit(
    frames: Float[np.ndarray, "frames h w"], centres: Float[np.ndarray, "dots 2"], radius: int
) -> Fits:
    """Fit the dots near `centres` (x, y), each within the square of `radius` pixels around it.

    A fit fails, and is NaN, where it leaves its square or the picture, explains less than half of
    the variance, or meets a value that is not finite.  Raises ValueError for a centre off the
    picture or a radius below 2.
    """
    height, width = frames.shape[1:]
    if radius < 2:
        raise ValueError(f"turbulence.radius must be >= 2 pixels, got {radius}")
    if ((centres < 0) | (centres > [width - 1, height - 1])).any():
        raise ValueError(f"dots must lie in the {width}x{height} picture, got {centres.tolist()}")
    results = np.full((6, len(frames), len(centres)), np.nan)
    for dot, centre in enumerate(np.round(centres).astype(int)):
        left, top = np.maximum(centre - radius, 0)
        right, bottom = np.minimum(centre + radius + 1, [width, height])
        y, x = np.mgrid[top:bottom, left:right].astype(np.float64)
        for first in range(0, len(frames), CHUNK):
            patch = frames[first : first + CHUNK, top:bottom, left:right]
            patch = patch.reshape(len(patch), -1).astype(np.float64)
            results[:, first : first + CHUNK, dot] = _fit(patch, x.ravel(), y.ravel()).T
    return Fits(*results)


def _fit(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Fit (k, pixels); return (k, 6): cx, cy, sx, sy, A, B, or NaN."""
    finite = np.isfinite(values).all(1) & (values.std(1) > 0)
    fitted = np.full((len(values), 6), np.nan)
    if not finite.any():
        return fitted
    values = values[finite]
    guess = _start(values, x, y)
    damping, cost = np.full(len(values), 1e-3), _residual(guess, values, x, y)[1]
    active = np.arange(len(values))
    for _ in range(STEPS):
        trial = _step(guess[active], damping[active], values[active], x, y)
        trial_cost = _residual(trial, values[active], x, y)[1]
        better = trial_cost < cost[active]
        far = np.abs(trial - guess[active]).max(1) > SETTLED
        guess[active[better]], cost[active[better]] = trial[better], trial_cost[better]
        damping[active] = np.clip(damping[active] * np.where(better, 0.2, 4), 1e-9, 1e9)
        active = active[far]
        if not active.size:
            break
    fitted[finite] = _accept(guess, cost, values, x, y)
    return fitted


def _start(values: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Moments of what stands out of the rim's median: cx, cy, log sx, log sy, A, B."""
    rim = (x == x.min()) | (x == x.max()) | (y == y.min()) | (y == y.max())
    background = np.median(values[:, rim], axis=1)
    rise = values - background[:, None]
    strongest = np.abs(rise).argmax(1)
    amplitude = np.take_along_axis(rise, strongest[:, None], 1)
    weight = np.clip(rise / amplitude - 0.3, 0, None)
    weight /= weight.sum(1, keepdims=True)
    cx, cy = weight @ x, weight @ y
    spread = (weight * ((x - cx[:, None]) ** 2 + (y - cy[:, None]) ** 2)).sum(1) / 2
    log_sigma = np.log(np.clip(1.5 * np.sqrt(spread), 0.5, None))
    return np.stack([cx, cy, log_sigma, log_sigma, amplitude[:, 0], background], axis=1)


def _step(guess, damping, values, x, y) -> np.ndarray:
    residual, slope = _derivatives(guess, values, x, y)
    gradient = slope @ residual[..., None]
    curvature = slope @ slope.transpose(0, 2, 1)
    diagonal = curvature[:, range(6), range(6)]
    curvature[:, range(6), range(6)] += damping[:, None] * diagonal + 1e-12
    trial = guess - np.linalg.solve(curvature, gradient)[..., 0]
    trial[:, 2:4] = np.clip(trial[:, 2:4], -2.5, 5.0)
    return trial


def _residual(guess, values, x, y):
    cx, cy, lx, ly, amplitude, background = (column[:, None] for column in guess.T)
    across, along = (x - cx) / np.exp(lx), (y - cy) / np.exp(ly)
    bell = np.exp(-(across**2 + along**2) / 2)
    residual = amplitude * bell + background - values
    return residual, (residual**2).sum(1), (across, along, bell)


def _derivatives(guess, values, x, y):
    residual, _, (across, along, bell) = _residual(guess, values, x, y)
    _, _, lx, ly, amplitude, _ = (column[:, None] for column in guess.T)
    peak = amplitude * bell
    centre = peak * across / np.exp(lx), peak * along / np.exp(ly)
    spread = peak * across**2, peak * along**2
    return residual, np.stack([*centre, *spread, bell, np.ones_like(bell)], axis=1)


def _accept(guess, cost, values, x, y):
    variance = ((values - values.mean(1, keepdims=True)) ** 2).sum(1)
    cx, cy, lx, ly = guess.T[:4]
    wide = max(np.ptp(x), np.ptp(y)) / 2
    good = (cx > x.min()) & (cx < x.max()) & (cy > y.min()) & (cy < y.max())
    good &= (cost < (1 - EXPLAINED) * variance) & (np.maximum(lx, ly) < np.log(wide))
    good &= np.minimum(lx, ly) > np.log(0.3)
    result = guess.copy()
    result[:, 2:4] = np.exp(result[:, 2:4])
    return np.where(good[:, None], result, np.nan)
