"""The blur of short exposures against drawn von Karman phase, Fried's form and its own limits."""

import math
from itertools import pairwise

import numpy as np
import pytest
from scipy import special

from src.sim.turbulence import short_exposure
from src.sim.turbulence.outer_scale import KAPPA0, average_over_path
from src.sim.turbulence.prior import PROFILES, unnormalised_cn2_profile
from tests.sim.turbulence.theory import draw_short_exposure_blur

STRENGTHS = np.array([1.0, 2.0, 4.0, 8.0])


@pytest.mark.parametrize(
    "ratio, path", [(2, "camera"), (1, "camera"), (1, "object"), (1, "uniform"), (1 / 3, "uniform")]
)
def test_blur_is_that_of_drawn_phase(ratio, path):
    low, high = PROFILES[path]
    layers = low + (high - low) * (np.arange(20) + 0.5) / 20
    drawn = draw_short_exposure_blur(STRENGTHS.tolist(), ratio, layers.tolist(), 320)
    profile = unnormalised_cn2_profile(path)
    found = short_exposure.blur_std_in_lambda_over_d(STRENGTHS, ratio, profile)
    print(f"L0 = {1 / ratio:.2f} D, {path}: {found / drawn} of drawn phase")
    np.testing.assert_allclose(found, drawn, rtol=0.05)


def test_strong_kolmogorov_turbulence_blurs_as_in_frieds_form():
    decay = 3.44 * short_exposure.NU ** (5 / 3) * (1 - short_exposure.NU ** (1 / 3))
    aperture = np.arccos(short_exposure.NU) - short_exposure.NU * np.sqrt(1 - short_exposure.NU**2)
    radii = np.geomspace(0.4, 30, 300)[:, None]
    rings = radii * special.j1(2 * math.pi * radii * short_exposure.NU)

    def radius(strength: float) -> float:
        light = rings @ (aperture * np.exp(-decay * strength ** (5 / 3)))
        return float(np.interp(0.5, light * 4 / len(short_exposure.NU), radii[:, 0]))

    for strength in (4.0, 6.0, 10.0):
        assert short_exposure.half_light_radius(strength) == pytest.approx(
            radius(strength), rel=0.02
        )
    weak = radius(1.0) ** 2 - radius(0.0) ** 2  # squares: Fried's blur is too large by 0.12
    assert weak > 1.2 * (short_exposure.half_light_radius(1.0) ** 2 - radius(0.0) ** 2)


def test_an_infinite_outer_scale_is_the_limit():
    found = short_exposure.blur_std_in_lambda_over_d(STRENGTHS, 1e-4, (1.0,))
    limit = short_exposure.blur_std_in_lambda_over_d(STRENGTHS)
    np.testing.assert_allclose(found, limit, rtol=0.003)
    for strength in STRENGTHS:
        same = short_exposure.blur_equivalent_d_over_r0(strength, 0.0, (1.0,))
        assert same == pytest.approx(strength, rel=1e-9)


def test_a_smaller_outer_scale_blurs_less():
    scales = [0.0, 1e-3, 0.1, 1 / 3, 1.0, 3.0, 30.0, 1000.0]
    blur = [short_exposure.blur_std_in_lambda_over_d(6.0, scale, (1.0,)) for scale in scales]
    assert all(after < before * 1.005 for before, after in pairwise(blur))
    assert blur[-1] < 0.05 * blur[0]
    assert short_exposure.blur_std_in_lambda_over_d(0.0, 1.0, (1.0,)) == 0


def test_stronger_turbulence_than_is_tabulated_is_refused():
    with pytest.raises(ValueError, match="d_over_r0 must be <= 40, got 50"):
        short_exposure.half_light_radius(50.0)


def test_turbulence_near_the_object_has_the_larger_outer_scale_in_footprints():
    near, far = ((0.0, *[0.0] * 60, *[1.0] * 30), (*[1.0] * 30, *[0.0] * 60))
    blur = [short_exposure.blur_std_in_lambda_over_d(6.0, 1.0, path) for path in (near, far)]
    assert blur[0] > 1.2 * blur[1]


def test_structure_functions_are_those_of_the_spectrum():
    """Against the integral of 2 (1 - J0) over the spectrum, for L0 = 0.1 D to 1000 D."""
    kappa = np.geomspace(1e-7, 1e5, 40_000)
    step = math.log(kappa[1] / kappa[0])
    every, places = short_exposure.phase_structure_functions(), [40, 200, 790]
    for scale in (17, 30, 46):  # of KAPPA0
        power = 2 * math.pi * 0.022896 * kappa**2 * (kappa**2 + KAPPA0[scale] ** 2) ** (-11 / 6)
        turns = 2 * math.pi * np.multiply.outer(short_exposure.NU[places], kappa)
        expected = 2 * (1 - special.j0(turns)) @ power * step
        np.testing.assert_allclose(every[scale, places], expected, rtol=0.005)


def test_the_mean_over_a_path_is_that_of_its_layers():
    place = (np.arange(120) + 0.5) / 120
    weight = (1 - place) ** (5 / 3) / ((1 - place) ** (5 / 3)).sum()
    table = np.stack([KAPPA0, np.log(np.maximum(KAPPA0, 1e-6))], 1)
    mean = average_over_path(table, 0.7, (1.0,))
    assert mean[1] == pytest.approx(weight @ np.log(0.7 * (1 - place)), abs=1e-9)
    assert mean[0] == pytest.approx(weight @ (0.7 * (1 - place)), rel=0.02)
    assert average_over_path(table, 0.0, (1.0,))[0] == 0
