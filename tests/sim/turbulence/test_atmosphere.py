"""One atmosphere's numbers, how they are refused and how they are drawn."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch

from src.sim.turbulence.atmosphere import Atmosphere, sample_atmosphere

PATH = Atmosphere(0.05, 0.5, 1000.0, 2.0, 525e-9, 3e-14, 0.9)


def test_pixels_follow_from_focal_length_distance_and_scene_width():
    assert PATH.pixel_pitch_m(256) == pytest.approx(0.5 * 2.0 / (1000.0 * 256))
    assert PATH.airy_px(256) == pytest.approx(525e-9 / 0.05 * 1000 * 256 / 2.0)
    assert PATH.tilt_std_px(512) == pytest.approx(2 * PATH.tilt_std_px(256))


@pytest.mark.parametrize("d_over_r0, name", [(1.4, "weak"), (1.6, "medium"), (4.1, "strong")])
def test_severity(d_over_r0, name):
    path = PATH.at(d_over_r0)
    assert path.d_over_r0 == pytest.approx(d_over_r0)
    assert path.severity == name


def test_no_turbulence_on_the_path():
    path = replace(PATH, cn2=0.0)
    assert (path.r0_m, path.d_over_r0, path.tilt_std_px(256), path.rytov) == (math.inf, 0, 0, 0)


@pytest.mark.parametrize(
    "field, value",
    [
        ("cn2", -1e-15),
        ("cn2", math.nan),
        ("cn2", (1e-14, -1e-14)),
        ("cn2", ()),
        ("aperture_m", 0.0),
        ("aperture_m", math.nan),
        ("distance_m", 0.0),
        ("focal_length_m", -1.0),
        ("scene_width_m", math.inf),
        ("wavelength_m", 0.0),
        ("alpha", 1.1),
        ("alpha", -0.1),
    ],
)
def test_values_outside_their_range_are_refused_by_name(field, value):
    with pytest.raises(ValueError, match=rf"turbulence\.atmosphere\.{field} must be .*got"):
        replace(PATH, **{field: value})


@pytest.mark.parametrize(
    "severity, limits", [("weak", (0.1, 1.5)), ("medium", (1.5, 4)), ("strong", (4, 10))]
)
def test_draws_are_what_was_asked_for(severity, limits):
    for seed in range(40):
        path = sample_atmosphere(severity, torch.Generator().manual_seed(seed))
        assert path.severity == severity
        assert limits[0] <= path.d_over_r0 < limits[1]
        assert path.rytov <= 0.3
        assert 0.4 <= path.airy_px(256) <= 2.0
        assert 0.02 < path.tilt_std_px(256) < 7


def test_mixed_is_the_papers_mix():
    drawn = [
        sample_atmosphere("mixed", torch.Generator().manual_seed(s)).severity for s in range(600)
    ]
    share = {name: count / 600 for name, count in Counter(drawn).items()}
    for name, expected in {"weak": 0.1, "medium": 0.3, "strong": 0.6}.items():
        assert share[name] == pytest.approx(
            expected, abs=4 * math.sqrt(expected * (1 - expected) / 600)
        )


def test_a_draw_is_a_function_of_the_generator():
    first, again, other = (
        sample_atmosphere("mixed", torch.Generator().manual_seed(seed)) for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other


def test_none_and_unknown_severities():
    assert sample_atmosphere("none", torch.Generator()) is None
    with pytest.raises(ValueError, match=r"severity must be none, weak.*got hopeless"):
        sample_atmosphere("hopeless", torch.Generator())


def test_ranges_that_cannot_be_met_and_bad_ranges():
    with pytest.raises(ValueError, match="no draw within its ranges is strong"):
        sample_atmosphere("strong", torch.Generator(), cn2=(1e-18, 1e-18))
    with pytest.raises(ValueError, match=r"cn2 must be a range above 0"):
        sample_atmosphere("strong", torch.Generator(), cn2=(0.0, 1e-14))
    with pytest.raises(ValueError, match=r"alpha must be a range low <= high"):
        sample_atmosphere("strong", torch.Generator(), alpha=(0.9, 0.5))
