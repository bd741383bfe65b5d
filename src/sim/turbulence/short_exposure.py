"""The blur of von Karman turbulence with tilt removed: mean transfer function and half-light radius.

With a2 the tilt along x (Noll 1976) and x in units of D, tilt removal leaves of two points of the
pupil, r1 and r2 = r1 - nu x, a phase difference of the variance

    S(nu) - 8 nu E[a2 (phi(r1) - phi(r2))] + 16 nu^2 E[a2^2],

S the structure function of the phase.  The mean transfer function is that of the aperture times
exp(-V(nu) / 2), V the mean of this variance over the points r1 and r2 that the pupil holds.  Fried's
form of it (1966), 6.88 (nu D/r0)^(5/3) (1 - nu^(1/3)), takes the phase that is left for independent
of the tilt: at D/r0 below 3 its blur is 12 to 15 % too large.  V grows as (D/r0)^(5/3); that of a
path is the mean over its layers, each with an outer scale in units of its footprint.
"""  # noqa: E501

import math
from functools import cache, lru_cache

import numpy as np
from jaxtyping import Float
from scipy import special

from src.sim.turbulence import outer_scale
from src.sim.turbulence.contract import check_option
from src.sim.turbulence.outer_scale import KAPPA, KAPPA0, Cn2Profile
from src.sim.turbulence.zernike import SPECTRUM

Strengths = Float[np.ndarray, "*strengths"] | float
UNIFORM: Cn2Profile = (1.0,)  # for an infinite outer scale, of which the profile changes nothing

NU = (np.arange(800) + 0.5) / 800  # D / wavelength
# With L0 near D the radius rises steeply between D/r0 2 and 10.
D_OVER_R0 = np.r_[
    0.0, np.geomspace(0.05, 1, 30), np.arange(1.05, 12, 0.05), np.geomspace(12, 40, 20)
]
RADII = np.geomspace(0.4, 60, 200)  # lambda / D
PUPIL_RADII = np.linspace(0, 0.5, 61)  # D
OVERLAP_POINTS = 48  # a quarter of the overlap of two shifted pupils has about the square of it
GAUSSIAN_HALF_LIGHT = math.sqrt(2 * math.log(2))  # half-light radius over standard deviation


def half_light_radius(
    d_over_r0: Strengths, aperture_over_outer_scale: float = 0.0, profile: Cn2Profile = UNIFORM
) -> Strengths:
    """Return the radius that holds half of a point's light, tilt removed, in lambda / D.

    `d_over_r0` 0..40 for an outer scale L0 = D / `aperture_over_outer_scale` (0: infinite) and Cn2
    along the path (see outer_scale); shape as `d_over_r0`.  Raises ValueError above 40.
    """
    strongest, most = float(np.max(d_over_r0)), float(D_OVER_R0[-1])
    check_option(strongest <= most, "atmosphere.d_over_r0", f"<= {most:g}", strongest)
    radii = _half_light_radii(aperture_over_outer_scale, tuple(profile))
    return np.interp(d_over_r0, D_OVER_R0, radii)


def blur_std_in_lambda_over_d(
    d_over_r0: Strengths, aperture_over_outer_scale: float = 0.0, profile: Cn2Profile = UNIFORM
) -> Strengths:
    """Return by how much turbulence blurs beyond diffraction, tilt removed, in lambda / D.

    The standard deviation along one axis of the Gaussian whose half-light radius, added in squares
    to that of diffraction, gives `half_light_radius`; arguments as there.
    """
    blurred = half_light_radius(d_over_r0, aperture_over_outer_scale, profile)
    return np.sqrt(blurred**2 - half_light_radius(0.0) ** 2) / GAUSSIAN_HALF_LIGHT


def blur_equivalent_d_over_r0(
    d_over_r0: float, aperture_over_outer_scale: float, profile: Cn2Profile
) -> float:
    """Return D / r0 of the Kolmogorov turbulence with the same half-light radius."""
    blurred = half_light_radius(d_over_r0, aperture_over_outer_scale, profile)
    return float(np.interp(blurred, _half_light_radii(0.0, UNIFORM), D_OVER_R0))


@lru_cache(maxsize=256)
def _half_light_radii(
    aperture_over_outer_scale: float, profile: Cn2Profile
) -> Float[np.ndarray, " strengths"]:
    variance = outer_scale.average_over_path(
        _tilt_removed_variances(), aperture_over_outer_scale, profile
    )
    aperture = 2 / math.pi * (np.arccos(NU) - NU * np.sqrt(1 - NU**2))
    transfer = aperture[:, None] * np.exp(-variance[:, None] / 2 * D_OVER_R0 ** (5 / 3))
    held = _light_within_radii() @ transfer
    return np.array([np.interp(0.5, column, RADII) for column in held.T])


@cache
def _light_within_radii() -> Float[np.ndarray, "radii nu"]:
    turns = 2 * math.pi * RADII[:, None]
    return turns * special.j1(turns * NU) / len(NU)


@cache
def _tilt_removed_variances() -> Float[np.ndarray, "scales nu"]:
    """Return V(nu) at D/r0 = 1 and the outer scales D / KAPPA0, in rad^2."""
    spectrum = 2 * math.pi * SPECTRUM * outer_scale.von_karman_spectra()
    tilt = 4 * special.jv(2, math.pi * KAPPA) / (math.pi * KAPPA)  # what a wave along x gives to a2
    variance = spectrum @ (tilt**2 / 2)
    with_phase = (spectrum * tilt) @ special.j1(2 * math.pi * np.multiply.outer(KAPPA, PUPIL_RADII))
    in_common = with_phase @ _difference_over_overlap().T
    residual = phase_structure_functions() - 8 * NU * in_common + 16 * NU**2 * variance[:, None]
    return np.maximum(residual, 0)


@cache
def phase_structure_functions() -> Float[np.ndarray, "scales nu"]:
    """Return the structure function of phase at D/r0 = 1 and the outer scales D / KAPPA0, in rad^2.

    6.88 nu^(5/3) (Fried 1966); with an outer scale Voitsekhovich 1995.
    """
    order, kolmogorov = 5 / 6, (24 / 5 * special.gamma(6 / 5)) ** (5 / 6)
    turns = 2 * math.pi * np.multiply.outer(KAPPA0[1:], NU)
    reach = special.gamma(order) - 2 ** (1 / 6) * turns**order * special.kv(order, turns)
    scale = kolmogorov * special.gamma(11 / 6) / math.pi ** (8 / 3)
    finite = scale * KAPPA0[1:, None] ** (-5 / 3) * reach
    return np.concatenate([2 * kolmogorov * NU[None] ** (5 / 3), finite])


@cache
def _difference_over_overlap() -> Float[np.ndarray, "nu pupil_radii"]:
    """Return the matrix from g at PUPIL_RADII to the mean of g(|r1|) cos1 - g(|r2|) cos2.

    Over points of the overlap of pupils shifted by nu along x; cos is that of a point's angle.
    """
    side = (np.arange(-OVERLAP_POINTS, OVERLAP_POINTS) + 0.5) / (2 * OVERLAP_POINTS)
    rows, step = [], PUPIL_RADII[1]
    for nu in NU:
        x, y = side * (1 - nu), side[side > 0] * math.sqrt(1 - nu**2)
        x, y = (part.ravel() for part in np.meshgrid(x, y))
        inside = np.hypot(np.abs(x) + nu / 2, y) <= 0.5
        x, y = x[inside] + nu / 2, y[inside]
        radius = np.hypot(x, y)  # of r1; r2 is its mirror image and gives as much
        low = np.minimum((radius / step).astype(int), len(PUPIL_RADII) - 2)
        share, weight = radius / step - low, 2 * x / radius / len(x)
        row = np.bincount(low, weight * (1 - share), len(PUPIL_RADII))
        rows.append(row + np.bincount(low + 1, weight * share, len(PUPIL_RADII)))
    return np.array(rows)
