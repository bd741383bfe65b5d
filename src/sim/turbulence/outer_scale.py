"""Statistics of the tilt of von Karman turbulence in closed form.

The phase of a layer has the power SPECTRUM r0^(-5/3) (f^2 + 1/L0^2)^(-11/6) (von Karman); L0 = inf
is Kolmogorov's.  A layer at z = u L is seen through a disc of D (1 - u), so with kappa = D (1 - u) f
and kappa0 = (1 - u) D / L0 its tilt has, up to a constant, the covariance

    Cn2(u) (1-u)^(5/3) integral kappa (kappa^2 + kappa0^2)^(-11/6) [2 J2(pi kappa) / (pi kappa)]^2 J0(2 pi kappa x) dkappa

for lines of sight x footprints apart, the mean over directions: x = s u / (1 - u) for points s D
apart at the object, x = v t / (D (1 - u)) for one point after a time t of wind.  Lengths are in
units of the aperture D.
"""  # noqa: E501

import math
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Float
from scipy import special
from scipy.interpolate import RegularGridInterpolator

Cn2Profile = tuple[float, ...]  # Cn2 at equally spaced points from the camera to the object
Lags = Float[np.ndarray, " lags"]

SLICES = 120  # of the path
KAPPA = np.exp(np.linspace(math.log(1e-14), math.log(30.0), 1600))
STEP = math.log(KAPPA[1] / KAPPA[0])
KAPPA0 = np.concatenate([[0.0], np.geomspace(1e-4, 100, 61)])
TILT = (2 * special.jv(2, math.pi * KAPPA) / (math.pi * KAPPA)) ** 2
LAYER_WIND_RATIO = 0.5  # rms of a layer's own wind over the wind that all layers share
NEAREST, FARTHEST = 1e-3, 1e4  # D; the ends of what is tabulated as a length
LAGS = np.geomspace(NEAREST, FARTHEST, 141)


def tilt_variance_over_kolmogorov(aperture_over_outer_scale: float, profile: Cn2Profile) -> float:
    """Return the share of the tilt's variance that an outer scale L0 = D /
    `aperture_over_outer_scale` leaves."""
    return _variance(aperture_over_outer_scale, profile) / float(_variances()[0, 0])


def average_over_path(
    table: Float[np.ndarray, "scales columns"],
    aperture_over_outer_scale: float,
    profile: Cn2Profile,
) -> Float[np.ndarray, " columns"]:
    """Return the mean over a path of a table of layers whose outer scale is D / KAPPA0."""
    place, weight = _path(profile)
    known, kappa0 = _log(KAPPA0), _log(aperture_over_outer_scale * (1 - place))
    high = np.searchsorted(known, kappa0).clip(1, len(known) - 1)
    share = (kappa0 - known[high - 1]) / (known[high] - known[high - 1])
    weights = np.bincount(high - 1, weight * (1 - share), len(known))
    return (weights + np.bincount(high, weight * share, len(known))) @ table


def tilt_correlation(
    aperture_over_outer_scale: float, profile: Cn2Profile, lags: Lags, *, wind: bool = False
) -> Lags:
    """Return the correlation of the tilt of two points `lags` D apart at the object.

    With `wind`: of one point with itself after a wind common to the path moved the air `lags` D.
    """
    place, weight = _path(profile)
    apart = np.multiply.outer(lags, (1 if wind else place) / (1 - place))
    kappa0 = np.broadcast_to(aperture_over_outer_scale * (1 - place), apart.shape)
    covariance = _covariance()((_log(kappa0), np.log(apart.clip(1e-6, 1e7)))) @ weight
    return covariance / _variance(aperture_over_outer_scale, profile)


@lru_cache(maxsize=4096)
def tilt_decay_distance(
    aperture_over_outer_scale: float, profile: Cn2Profile, *, wind: bool = False
) -> float:
    """Return the distance in D at which the tilt's correlation falls to 1/2.

    With `wind`, to 1 / e: the way of a wind of the rms speed, in the mean over winds that differ
    from layer to layer (LAYER_WIND_RATIO).  NEAREST to FARTHEST, which stands for any longer one.
    """
    level = math.exp(-1) if wind else 0.5
    correlation = _correlation_over_lags(aperture_over_outer_scale, profile, wind)
    first = int((correlation < level).argmax())
    if first == 0:
        return FARTHEST if correlation[0] >= level else NEAREST
    ends = slice(first - 1, first + 1)
    return float(np.exp(np.interp(-level, -correlation[ends], np.log(LAGS[ends]))))


def global_tilt_share(
    aperture_over_outer_scale: float, profile: Cn2Profile, view_side_over_d: float
) -> float:
    """Return the share of the tilt's variance that moves all of a square view of that side.

    The mean correlation of two of its points; the density of their distance: Philip (2007).
    """
    apart = math.sqrt(2) * (np.arange(200) + 0.5) / 200
    far = np.sqrt(np.maximum(apart**2 - 1, 0))
    beyond = 4 * far - apart**2 - 2 + math.pi - 4 * np.arctan(far)
    weight = apart * np.where(apart < 1, apart**2 - 4 * apart + math.pi, beyond)
    known = _correlation_over_lags(aperture_over_outer_scale, profile, False)
    correlation = np.interp(np.log(apart * view_side_over_d), np.log(LAGS), known)
    return float(weight @ correlation / weight.sum())


@lru_cache(maxsize=4096)
def _correlation_over_lags(
    aperture_over_outer_scale: float, profile: Cn2Profile, wind: bool
) -> Lags:
    known = tilt_correlation(aperture_over_outer_scale, profile, LAGS, wind=wind)
    if not wind:
        return known
    ways = np.log(LAGS[:, None] * _relative_wind_speeds())
    return np.interp(ways, np.log(LAGS), known).mean(1)


@cache
def _relative_wind_speeds() -> Float[np.ndarray, " quantiles"]:
    """Return speeds of a layer's wind, as likely as each other, over the rms speed (Rice's law)."""
    quantile, spread = (np.arange(32) + 0.5) / 32, LAYER_WIND_RATIO / math.sqrt(2)
    speeds = spread * np.sqrt(special.chndtrix(quantile, 2, spread**-2))
    return speeds / math.sqrt(1 + LAYER_WIND_RATIO**2)


@cache
def von_karman_spectra() -> Float[np.ndarray, "scales kappa"]:
    """Return kappa (kappa^2 + kappa0^2)^(-11/6) d kappa for each KAPPA0."""
    return KAPPA**2 * (KAPPA**2 + KAPPA0[:, None] ** 2) ** (-11 / 6) * STEP


@cache
def _variances() -> Float[np.ndarray, "scales 1"]:
    return (von_karman_spectra() @ TILT)[:, None]


def _variance(aperture_over_outer_scale: float, profile: Cn2Profile) -> float:
    return float(average_over_path(_variances(), aperture_over_outer_scale, profile)[0])


@cache
def _covariance() -> RegularGridInterpolator:
    """Return the tilt's covariance over log kappa0 and log of the distance in footprints."""
    apart = np.geomspace(1e-6, 1e7, 400)
    waves = special.j0(2 * math.pi * np.multiply.outer(KAPPA, apart))
    values = (von_karman_spectra() * TILT) @ waves
    return RegularGridInterpolator((_log(KAPPA0), np.log(apart)), values)


def _log(kappa0: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    return np.log(np.clip(kappa0, 1e-6, 100))


def _path(profile: Cn2Profile) -> tuple[np.ndarray, np.ndarray]:
    """Return z / L of slices and their weight in the tilt, Cn2 (1 - z/L)^(5/3), summing to 1."""
    place = (np.arange(SLICES) + 0.5) / SLICES
    knots = np.linspace(0, 1, len(profile)) if len(profile) > 1 else [0.5]
    weight = np.interp(place, knots, profile) * (1 - place) ** (5 / 3)
    return place, weight / weight.sum()
