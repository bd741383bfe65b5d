"""How far turbulence blurs a point once its tilt is removed, from Fried's short exposure."""

import math
from functools import cache

import numpy as np
from scipy import special

STRENGTHS = np.concatenate([[0.0], np.geomspace(0.05, 40, 60)])
RADII = np.geomspace(0.4, 60, 200)  # lambda / D
GAUSSIAN = math.sqrt(2 * math.log(2))  # half-light radius of a Gaussian over its deviation


def half_light(d_over_r0: float) -> float:
    """Return the radius that holds half of a point's light, tilt removed, in lambda / D.

    From the mean transfer function T(nu) exp(-3.44 (nu D/r0)^(5/3) (1 - nu^(1/3))), nu in units of
    D / lambda and T that of the aperture (Fried 1966, near field).
    """
    return float(np.interp(d_over_r0, STRENGTHS, _radii()))


def blur_growth(d_over_r0: float) -> float:
    """Return by how much turbulence blurs beyond diffraction, tilt removed, in lambda / D.

    The standard deviation along one axis of the Gaussian whose half-light radius, added in squares
    to that of diffraction, gives `half_light`.
    """
    return math.sqrt(half_light(d_over_r0) ** 2 - half_light(0.0) ** 2) / GAUSSIAN


@cache
def _radii() -> np.ndarray:
    nu = (np.arange(1500) + 0.5) / 1500
    aperture = 2 / math.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    rings = 2 * math.pi * RADII[:, None] * special.j1(2 * math.pi * RADII[:, None] * nu) / len(nu)
    decay = -3.44 * nu ** (5 / 3) * (1 - nu ** (1 / 3))
    light = [rings @ (aperture * np.exp(decay * s ** (5 / 3))) for s in STRENGTHS]
    return np.array([np.interp(0.5, held, RADII) for held in light])
