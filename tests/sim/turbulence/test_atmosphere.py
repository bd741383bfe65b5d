"""One atmosphere's numbers, and how they are refused."""

import math
from dataclasses import replace

import pytest
import torch

from src.sim.optics import layout
from src.sim.turbulence import Atmosphere, plane_waves
from src.sim.turbulence.atmosphere import AR1_FPS
from src.sim.turbulence.fidelity import choose_fidelity
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.plane_waves import WaveDynamics, draw_plane_waves
from src.sim.turbulence.prior import sample_atmosphere

PATH = Atmosphere(0.05, 0.5, 1000.0, 2.0, 525e-9, 3e-14, 0.9)


def test_pixels_follow_from_focal_length_distance_and_scene_width():
    assert PATH.lambda_over_d_px(256) == pytest.approx(525e-9 / 0.05 * 1000 * 256 / 2.0)
    assert PATH.tilt_std_px(512) == pytest.approx(2 * PATH.tilt_std_px(256))


def test_severity_is_what_is_seen():
    paths = [PATH.with_d_over_r0(d_over_r0) for d_over_r0 in (0.5, 1.4, 4.0, 16.0)]
    assert [path.severity for path in paths] == ["weak", "medium", "strong", "extreme"]
    _, medium, strong, _ = paths
    assert strong.d_over_r0 == pytest.approx(4.0)
    enlarged = replace(medium, scene_width_m=1.0)  # the same air through a longer lens
    assert enlarged.severity == "strong"


def test_no_turbulence_on_the_path():
    path = replace(PATH, cn2=0.0)
    assert path.r0_m == math.inf
    assert path.d_over_r0 == path.tilt_std_px(256) == path.rytov_variance == 0


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
        ("ar1_coefficient", 1.1),
        ("ar1_coefficient", -0.1),
        ("outer_scale_m", 0.0),
        ("outer_scale_m", -1.0),
        ("outer_scale_m", math.nan),
        ("wind_m_s", math.inf),
    ],
)
def test_values_outside_their_range_are_refused_by_name(field, value):
    with pytest.raises(ValueError, match=rf"turbulence\.atmosphere\.{field} must be .*got"):
        replace(PATH, **{field: value})


def test_a_path_without_turbulence_is_not_scaled():
    with pytest.raises(ValueError, match="cn2 must not be 0"):
        PATH.with_d_over_r0(0.0).with_d_over_r0(2.0)


def test_what_stands_still_has_no_end_of_its_correlation():
    still = replace(PATH, ar1_coefficient=1.0)
    assert WaveDynamics("ar1").describe(still)["tilt_correlation_time_s"] == math.inf
    found = WaveDynamics("frozen_flow", wind_m_s=0).describe(PATH)
    assert found["tilt_correlation_time_s"] == math.inf and found["wind_m_s"] == 0


def test_the_blur_that_is_recorded_is_that_beyond_diffraction():
    found = choose_fidelity(PATH, 256, 0.26)
    both = math.hypot(found.tilt_px, found.blur_px)
    assert both == pytest.approx(found.tilt_and_blur_px, rel=1e-6)


def test_the_correlation_time_that_is_recorded_is_that_of_the_wind():
    atmosphere = sample_atmosphere("strong", torch.Generator().manual_seed(1))
    drawn_s = -1 / (AR1_FPS * math.log(atmosphere.ar1_coefficient))
    for model in ("ar1", "frozen_flow", "mixed"):
        found = WaveDynamics(model).describe(atmosphere)
        assert found["tilt_correlation_time_s"] == pytest.approx(drawn_s, rel=1e-3)
        assert found["temporal_model"] == model
        assert found["wind_m_s"] == (0 if model == "ar1" else atmosphere.wind_m_s)
    twice = WaveDynamics("frozen_flow", wind_m_s=2 * atmosphere.wind_m_s).describe(atmosphere)
    assert twice["tilt_correlation_time_s"] == pytest.approx(drawn_s / 2, rel=1e-3)


def test_a_clip_of_mixed_records_the_temporal_model_that_it_has():
    atmosphere = sample_atmosphere("weak", torch.Generator().manual_seed(1))
    options = {"views": 1, "height": 16, "width": 16}
    mixed, *single = (
        Turbulence(atmosphere, temporal_model=model, **options)
        for model in ("mixed", "ar1", "frozen_flow")
    )
    seen = set()
    for seed in range(6):
        moves, *own = (one.tilt(3, torch.Generator().manual_seed(seed)) for one in (mixed, *single))
        model = mixed.clip_metadata(torch.Generator().manual_seed(seed))["temporal_model"]
        assert torch.equal(moves, own[model == "frozen_flow"])
        assert not torch.equal(moves, own[model == "ar1"])
        seen.add(model)
    assert seen == {"ar1", "frozen_flow"}


@pytest.mark.parametrize("model", ["ar1", "frozen_flow"])
@pytest.mark.parametrize("views", ["independent", "baseline"])
def test_views_drawn_one_after_the_other_are_those_drawn_together(model, views, monkeypatch):
    dynamics = WaveDynamics(model, views_correlation=views)
    waves = draw_plane_waves(PATH, 5, modes=2, waves=32, width_px=64)
    given = PATH, waves, 7, layout(4), 37, 120.0
    together = dynamics.draw_amplitudes(*given)
    monkeypatch.setattr(plane_waves, "NUMBERS_AT_A_TIME", 1)
    assert torch.equal(dynamics.draw_amplitudes(*given), together) and len(together) == 4
