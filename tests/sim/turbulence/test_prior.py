"""How atmospheres are drawn: what is seen is what was asked for."""

import math
from collections import Counter

import numpy as np
import pytest
import torch

from src.sim.turbulence import sample_atmosphere
from src.sim.turbulence.prior import SPREADS, Appearance, matching, profile
from src.sim.turbulence.rigid import rigid_atmosphere
from src.sim.turbulence.simulated import SimulatedAir


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


@pytest.mark.parametrize("severity", ["weak", "medium", "strong"])
def test_draws_are_what_was_asked_for(severity):
    low, high = SPREADS[severity]
    for seed in range(40):
        path = sample_atmosphere(severity, generator(seed))
        assert path.severity == severity
        assert low * 0.98 <= path.spread_px(256) <= high * 1.02
        assert 4.5 <= path.half_length_px(256) <= 650
        assert 0.4 <= path.airy_px(256) <= 2.0
        assert 1 <= path.aperture_m / path.object_pixel_m(256) <= 60
        assert path.rytov <= 3.05 and 0.05 <= path.d_over_r0 <= 10.01


def test_half_lengths_are_log_uniform_and_some_air_is_rigid():
    lengths = np.array(
        [sample_atmosphere("mixed", generator(s)).half_length_px(256) for s in range(600)]
    )
    rigid = (lengths > 100).mean()
    assert rigid == pytest.approx(0.15, abs=4 * math.sqrt(0.15 * 0.85 / 600) + 0.02)
    local = np.log(lengths[lengths < 100] / 5) / math.log(20)
    middle = np.median(local)  # what no camera shows is drawn again, so strong and short is rarer
    assert 0.4 < middle < 0.65


def test_mixed_is_the_papers_mix():
    drawn = Counter(sample_atmosphere("mixed", generator(seed)).severity for seed in range(600))
    for name, expected in {"weak": 0.1, "medium": 0.3, "strong": 0.6}.items():
        error = 4 * math.sqrt(expected * (1 - expected) / 600)
        assert drawn[name] / 600 == pytest.approx(expected, abs=error)


def test_a_draw_is_a_function_of_the_generator():
    first, again, other = (sample_atmosphere("mixed", generator(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("tilt_px, half_length_px", [(0.3, 8.0), (0.64, 15.0), (1.2, 60.0)])
def test_a_camera_that_shows_measured_air(tilt_px, half_length_px):
    seen = Appearance(half_length_px, decay_s=0.05, tilt_px=tilt_px)
    for seed in range(8):
        path = matching(seen, generator(seed))
        assert path.tilt_std_px(256) == pytest.approx(tilt_px, rel=0.03)
        assert path.half_length_px(256) == pytest.approx(half_length_px, rel=0.01)
        assert -1 / (120 * math.log(path.alpha)) == pytest.approx(0.05)


def test_the_blur_that_is_wanted_is_the_nearest_there_is():
    def blur(wanted: float) -> float:
        path = matching(Appearance(20.0, 0.05, tilt_px=0.5, blur_px=wanted), generator(3))
        return math.sqrt(path.spread_px(256) ** 2 - path.tilt_std_px(256) ** 2)

    assert blur(0.3) == pytest.approx(0.3, rel=0.25)
    assert blur(0.9) == pytest.approx(0.9, rel=0.25)


def test_none_and_unknown_severities():
    assert sample_atmosphere("none", generator(0)) is None
    with pytest.raises(ValueError, match=r"severity must be none, weak.*got hopeless"):
        sample_atmosphere("hopeless", generator(0))


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"aperture_px": (1e-6, 1e-5)}, "no camera within its ranges shows"),
        ({"half_length_px": (0.0, 5.0)}, "half_length_px must be a range above 0"),
        ({"decay_s": (0.5, 0.1)}, "decay_s must be a range low <= high"),
        ({"near_rigid": 1.5}, r"near_rigid must be in \[0, 1\], got 1.5"),
        ({"outer_scale_d": (0.0, 1.0)}, "outer_scale_d must be a range above 0"),
        ({"profiles": ["upwards"]}, "profiles must be of uniform, camera.*got upwards"),
        ({"profiles": [[0.0, 0.0]]}, "profiles must be tables of Cn2 >= 0, somewhere > 0"),
        ({"profiles": [[1.0, -1.0]]}, "profiles must be tables of Cn2 >= 0, somewhere > 0"),
    ],
)
def test_ranges_that_cannot_be_met_and_bad_ranges(settings, message):
    with pytest.raises(ValueError, match=rf"turbulence\.atmosphere.*{message}"):
        sample_atmosphere("strong", generator(0), **{"near_rigid": 0.0} | settings)


def test_profiles_by_name_and_by_table():
    assert sum(profile("camera")[:13]) == sum(profile("camera"))
    assert profile([0, 2.5]) == (0.0, 2.5)
    path = sample_atmosphere("medium", generator(0), profiles=[[0.0, 1.0, 3.0]])
    assert path.profile[2] == pytest.approx(3 * path.profile[1])


def test_the_rigid_prior_draws_by_the_ratio_of_aperture_and_fried_parameter():
    for severity, limits in {"weak": (0.1, 1.5), "medium": (1.5, 4), "strong": (4, 10)}.items():
        for seed in range(20):
            path = rigid_atmosphere(severity, generator(seed))
            assert limits[0] <= path.d_over_r0 < limits[1]
            assert path.rytov <= 0.3 and math.isinf(path.outer_scale_m)
    with pytest.raises(ValueError, match="no draw within its ranges is strong"):
        rigid_atmosphere("strong", generator(0), cn2=(1e-18, 1e-18))
    with pytest.raises(ValueError, match=r"alpha must be a range low <= high"):
        rigid_atmosphere("strong", generator(0), alpha=(0.9, 0.5))


def test_a_config_of_before_there_were_two_priors_is_rigid():
    former = SimulatedAir({"severity": "medium", "cn2": [0.5e-14, 300e-14]})
    assert former.draw(generator(3)) == rigid_atmosphere("medium", generator(3))
    assert former.having(tolerance=0.5).draw(generator(3)) == former.draw(generator(3))
    with pytest.raises(ValueError, match="prior must be of seen, rigid, got new"):
        SimulatedAir({"prior": "new", "severity": "weak"})
