"""How atmospheres are drawn: what is seen is what was asked for."""

import math
import re
from collections import Counter

import numpy as np
import pytest
from omegaconf import OmegaConf

from src.app.compose import compose_config
from src.sim.noise import generator
from src.sim.turbulence import Atmosphere, prior_trial, sample_atmosphere
from src.sim.turbulence.prior import (
    TILT_AND_BLUR_PX,
    NoCameraError,
    TargetImageStatistics,
    sample_matching_atmosphere,
    unnormalised_cn2_profile,
)
from src.sim.turbulence.simulated import INTERVALS, SimulatedTurbulence


@pytest.mark.parametrize("severity", ["weak", "medium", "strong"])
def test_draws_are_what_was_asked_for(severity):
    low, high = TILT_AND_BLUR_PX[severity]
    for seed in range(40):
        path = sample_atmosphere(severity, generator(seed))
        assert path.severity == severity
        assert low * 0.98 <= path.tilt_and_blur_px(256) <= high * 1.02
        assert 4.5 <= path.tilt_correlation_half_length_px(256) <= 650
        assert 0.4 <= path.lambda_over_d_px(256) <= 2.0
        assert 1 <= path.aperture_m / path.pixel_size_at_object_m(256) <= 60
        assert path.rytov_variance <= 3.05 and 0.05 <= path.d_over_r0 <= 10.01


def test_extreme_turbulence_needs_more_than_weak_scintillation():
    """Large tilt over short lengths: no path below a Rytov variance of 3 shows it."""
    half_length = {"tilt_correlation_half_length_px": (7.0, 15.0), "global_tilt_probability": 0.0}
    with pytest.raises(NoCameraError):
        tilt_and_blur_px = {"extreme": (5, 7)}
        sample_atmosphere("extreme", generator(0), tilt_and_blur_px=tilt_and_blur_px, **half_length)
    for seed in range(10):
        path = sample_atmosphere("extreme", generator(seed), **half_length, max_rytov_variance=30)
        assert path.severity == "extreme"
        assert 3.4 <= path.tilt_and_blur_px(256) <= 7.1
        assert 6.9 <= path.tilt_correlation_half_length_px(256) <= 15.1


@pytest.fixture(scope="module")
def mixed() -> list[Atmosphere]:
    """Six hundred atmospheres of the mix."""
    return [sample_atmosphere("mixed", generator(seed)) for seed in range(600)]


def test_half_lengths_are_log_uniform_and_some_of_whole_views(mixed):
    lengths = np.array([path.tilt_correlation_half_length_px(256) for path in mixed])
    rigid = (lengths > 100).mean()
    assert rigid == pytest.approx(0.15, abs=4 * math.sqrt(0.15 * 0.85 / 600) + 0.02)
    local = np.log(lengths[lengths < 100] / 5) / math.log(20)
    middle = np.median(local)  # what no camera shows is drawn again, so strong and short is rarer
    assert 0.4 < middle < 0.65


def test_mixed_is_the_papers_mix(mixed):
    drawn = Counter(path.severity for path in mixed)
    for name, expected in {"weak": 0.1, "medium": 0.3, "strong": 0.6}.items():
        error = 4 * math.sqrt(expected * (1 - expected) / 600)
        assert drawn[name] / 600 == pytest.approx(expected, abs=error)


def test_a_draw_is_a_function_of_the_generator():
    first, again, other = (sample_atmosphere("mixed", generator(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("tilt_px, length_px", [(0.3, 8.0), (0.64, 15.0), (1.2, 60.0)])
def test_a_camera_that_shows_measured_turbulence(tilt_px, length_px):
    seen = TargetImageStatistics(length_px, tilt_correlation_time_s=0.05, tilt_px=tilt_px)
    for seed in range(8):
        path = sample_matching_atmosphere(seen, generator(seed))
        assert path.tilt_std_px(256) == pytest.approx(tilt_px, rel=0.03)
        assert path.tilt_correlation_half_length_px(256) == pytest.approx(length_px, rel=0.01)
        assert -1 / (120 * math.log(path.ar1_coefficient)) == pytest.approx(0.05)


def test_the_blur_that_is_wanted_is_the_nearest_there_is():
    for wanted in (0.3, 0.5, 0.8):
        statistics = TargetImageStatistics(20.0, 0.05, tilt_px=0.5, blur_px=wanted)
        path = sample_matching_atmosphere(statistics, generator(3))
        assert path.blur_px(256) == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("limits", [(0.1, 1.0), (1.0, 1000.0), (50.0, 60.0)])
def test_outer_scales_are_log_uniform_in_their_range(limits):
    given = {"outer_scale_over_aperture": limits, "kolmogorov_probability": 0.0}
    paths = [sample_atmosphere("medium", generator(seed), **given) for seed in range(60)]
    drawn = np.log([1 / path.aperture_over_outer_scale for path in paths])
    low, high = np.log(limits)
    assert low - 1e-6 <= drawn.min() < low + 0.4 * (high - low)
    assert high + 1e-6 >= drawn.max() > high - 0.4 * (high - low)


def test_none_and_unknown_severities():
    assert sample_atmosphere("none", generator(0)) is None
    with pytest.raises(ValueError, match=r"severity must be none, weak.*got hopeless"):
        sample_atmosphere("hopeless", generator(0))


def test_ranges_that_nothing_meets():
    with pytest.raises(NoCameraError) as error:
        sample_atmosphere("strong", generator(0), allowed_aperture_px=(1e-6, 1e-5))
    number = r"\d+\.?\d{0,3}"  # no more digits than one reads
    names = "tilt_correlation_half_length_px", "tilt_correlation_time_s", "tilt_and_blur_px"
    shown = ", ".join(f"{name}={number}" for name in names)
    assert re.match(
        f"turbulence.atmosphere must be ranges within which a camera shows {shown}; wider",
        str(error.value),
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"tilt_correlation_half_length_px": [1, 2]}, "got [1, 2], of which they show 5 of 64"),
        (
            {"tilt_correlation_half_length_px": [0.3, 0.5], "global_tilt_probability": 0},
            "must be within 2.2 to 1000 for tilt_and_blur_px.strong=[1.2, 3.0] and these cameras",
        ),
        ({"allowed_aperture_px": [0, 1e-5]}, "got ranges within which none does"),
    ],
)
def test_ranges_that_cameras_hardly_show_are_refused_before_any_clip(given, message):
    """Clips of global tilt would stand in for them."""
    with pytest.raises(ValueError, match=r"^turbulence.atmosphere[. ].*must be") as error:
        SimulatedTurbulence({"severity": "strong"} | given)
    assert message in str(error.value)


@pytest.mark.parametrize("severity", ["weak", "medium", "strong", "extreme", "mixed"])
def test_shipped_ranges_are_met_with_margin(severity, monkeypatch):
    cfg = compose_config("simulate", f"turbulence={severity}")
    atmosphere = OmegaConf.to_container(cfg.turbulence.atmosphere, resolve=True)
    monkeypatch.setattr(prior_trial, "LEAST_SHARE", 0.9)
    SimulatedTurbulence(atmosphere)


@pytest.mark.parametrize("name", INTERVALS)
@pytest.mark.parametrize(
    "wrong", [[1, 2, 3], [], ["a", "b"], [[1, 2], 3], [5, 1], [-2, -1], [math.nan] * 2, 3, None]
)
def test_every_range_is_checked_at_once_whatever_is_drawn(name, wrong):
    group, _, severity = name.partition(".")
    given = {group: {severity: wrong} if severity else wrong}
    with pytest.raises(
        ValueError, match=rf"^turbulence.atmosphere.{name} must be a range .*, got "
    ):
        SimulatedTurbulence({"severity": "medium"} | given)


@pytest.mark.parametrize(
    "settings, message",
    [
        ({"distance_m": [1e30, 1e30]}, "distance_m must be a range 0.001 <= low <= high <= 1e+06"),
        ({"tilt_correlation_time_s": [0.0, 5.0]}, "tilt_correlation_time_s must be a range 1e-06"),
        ({"f_number": [1e30, 1e30]}, "f_number must be a range 0.1 <= low <= high <= 10000, got"),
        ({"global_tilt_probability": 1.5}, "global_tilt_probability must be in [0, 1], got 1.5"),
        ({"kolmogorov_probability": [1]}, "kolmogorov_probability must be in [0, 1], got [1]"),
        ({"max_rytov_variance": 0}, "max_rytov_variance must be >= 1e-06, got 0"),
        ({"max_rytov_variance": math.nan}, "max_rytov_variance must be >= 1e-06, got nan"),
        ({"wavelength_m": -1}, "wavelength_m must be in [1e-07, 0.0001], got -1"),
        ({"wavelength_m": 1e11}, "wavelength_m must be in [1e-07, 0.0001], got 100000000000.0"),
        ({"width_px": math.inf}, "width_px must be in [1, 1e+05], got inf"),
        ({"width_px": None}, "width_px must be in [1, 1e+05], got None"),
        ({"cn2_profiles": []}, "cn2_profiles must be a list of names or tables, got []"),
        ({"cn2_profiles": [1, 2]}, "cn2_profiles must be names or tables of Cn2 >= 0, somewhere >"),
        ({"cn2_profiles": [["a"]]}, "cn2_profiles must be names or tables of Cn2 >= 0, somewhere"),
        ({"cn2_profiles": ["upwards"]}, "cn2_profiles must be of uniform, camera, middle, object"),
        ({"cn2_profiles": [[0.0, 0.0]]}, "cn2_profiles must be names or tables of Cn2 >= 0, some"),
        ({"cn2_profiles": [[1.0, -1.0]]}, "cn2_profiles must be names or tables of Cn2 >= 0, som"),
    ],
)
def test_settings_outside_their_range_are_named(settings, message):
    with pytest.raises(ValueError, match=re.escape(f"turbulence.atmosphere.{message}")):
        SimulatedTurbulence({"severity": "none"} | settings)


def test_profiles_by_name_and_by_table():
    assert sum(unnormalised_cn2_profile("camera")[:13]) == sum(unnormalised_cn2_profile("camera"))
    assert unnormalised_cn2_profile([0, 2.5]) == (0.0, 2.5)
    path = sample_atmosphere("medium", generator(0), cn2_profiles=[[0.0, 1.0, 3.0]])
    assert path.cn2_profile[2] == pytest.approx(3 * path.cn2_profile[1])


def test_what_cameras_show_is_tried_once_for_the_same_settings(monkeypatch):
    tried, draw = [], prior_trial.draw_atmosphere_once

    def count(*given, **settings):
        tried.append(settings)
        return draw(*given, **settings)

    monkeypatch.setattr(prior_trial, "draw_atmosphere_once", count)
    given = {"severity": "weak", "distance_m": [321.0, 4321.0]}
    SimulatedTurbulence(given | {"tilt_and_blur_px": {"weak": [1, 2]}})
    once = len(tried)
    SimulatedTurbulence(given | {"tilt_and_blur_px": {"weak": (1.0, 2.0)}})
    assert once > 0 and len(tried) == once
    SimulatedTurbulence(given | {"tilt_and_blur_px": {"weak": [1, 3]}})
    assert len(tried) == 2 * once
