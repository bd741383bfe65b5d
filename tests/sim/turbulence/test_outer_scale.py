"""Von Karman air against its closed forms and tables: variance, half length, structure function."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import special

from src.sim import noise
from src.sim.turbulence import Atmosphere, Turbulence, outer_scale
from src.sim.turbulence.plane_waves import draw_plane_waves
from src.sim.turbulence.prior import unnormalised_cn2_profile
from tests.sim.turbulence.theory import isoplanatic_angle_rad

RATIOS = (0.0, 1 / 100, 1 / 30, 1 / 10, 1 / 3, 1.0)  # D / L0
HALF_LENGTHS = {  # of the tilt at the object, in D, spherical wave
    "uniform": (10.9, 4.7, 3.2, 2.0, 1.0, 0.45),
    "camera": (65, 29, 20, 13, 8.4, 5.9),
    "middle": (2.8, 1.6, 1.2, 0.86, 0.57, 0.37),
    "object": (0.68, 0.42, 0.34, 0.25, 0.19, 0.14),
}
VARIANCES = (1, 0.74, 0.60, 0.43, 0.20, 0.05)  # of the tilt in uniform air, against L0 = inf
PATH = Atmosphere(0.1, 1.0, 1000.0, 1.28, 525e-9, 1e-15, 0.0)


def drawn(path: Atmosphere, modes: int = 2):
    return draw_plane_waves(path, 5, modes=modes, waves=40_000, width_px=256)


@pytest.mark.parametrize("place", HALF_LENGTHS)
def test_half_lengths_of_theory_are_those_of_the_table(place):
    profile = unnormalised_cn2_profile(place)
    found = [outer_scale.tilt_decay_distance(ratio, profile) for ratio in RATIOS]
    np.testing.assert_allclose(found, HALF_LENGTHS[place], rtol=0.15)  # two digits, few slices


@pytest.mark.parametrize("place", HALF_LENGTHS)
@pytest.mark.parametrize("ratio", RATIOS)
def test_the_waves_that_are_drawn_have_this_variance_and_half_length(place, ratio):
    shape = unnormalised_cn2_profile(place)
    path = replace(PATH, cn2=shape).with_d_over_r0(1.0)
    path = replace(path, outer_scale_m=PATH.aperture_m / ratio if ratio else math.inf)
    waves = drawn(path)
    power = waves.response[:2].square().sum((0, 2)).numpy() / 2
    expected = outer_scale.tilt_variance_over_kolmogorov(ratio, shape) * 0.448879
    assert power.sum() == pytest.approx(expected, rel=0.04)
    apart = path.tilt_correlation_half_length_px(256)
    turn = 2 * math.pi * waves.frequency_per_px.norm(dim=-1).numpy() * apart
    assert (power * special.j0(turn)).sum() / power.sum() == pytest.approx(0.5, abs=0.03)


def test_the_variance_of_uniform_air_is_the_tables():
    found = [outer_scale.tilt_variance_over_kolmogorov(ratio, (1.0,)) for ratio in RATIOS]
    np.testing.assert_allclose(found, VARIANCES, rtol=0.03)


def test_the_fields_of_clips_have_the_half_length():
    path = replace(PATH.with_d_over_r0(2.0), outer_scale_m=0.1)
    air = Turbulence(path, views=1, height=128, width=128)
    apart = round(path.tilt_correlation_half_length_px(128))
    lag = np.array([apart * path.pixel_size_at_object_m(128) / path.aperture_m])
    expected = outer_scale.tilt_correlation(1.0, path.normalised_profile, lag)[0]
    tilt = torch.stack([air.tilt(8, noise.generator(seed))[0] for seed in range(24)])
    power = tilt.square().mean()
    along = [
        (tilt[..., apart:] * tilt[..., :-apart]).mean(),
        (tilt[..., apart:, :] * tilt[..., :-apart, :]).mean(),
    ]
    assert float(sum(along) / 2 / power) == pytest.approx(expected, abs=0.05)
    assert 0.45 < expected < 0.6
    assert float(power.sqrt()) == pytest.approx(path.tilt_std_px(128), rel=0.06)


def test_time_of_decay_in_the_wind():
    path = replace(PATH, outer_scale_m=0.2).with_d_over_r0(1.0)
    reach = outer_scale.tilt_decay_distance(
        path.aperture_over_outer_scale, path.normalised_profile, wind=True
    )
    waves = drawn(path)
    power = waves.response[:2].square().sum((0, 2)).numpy()
    way = 2 * math.pi * waves.frequency_per_m.norm(dim=-1).numpy() * reach * path.aperture_m
    common, own = np.random.default_rng(0).standard_normal((2, 400, 2))  # winds of 400 clips
    common /= np.linalg.norm(common, axis=1, keepdims=True)
    speeds = np.linalg.norm(common + 0.5 / math.sqrt(2) * own, axis=1) / math.sqrt(1.25)
    left = (power * special.j0(np.multiply.outer(speeds, way))).sum(1).mean() / power.sum()
    assert left == pytest.approx(math.exp(-1), abs=0.03)


def test_the_isoplanatic_angle_grows_with_fewer_large_eddies():
    paths = [replace(PATH, outer_scale_m=size) for size in (math.inf, 1e5, 10, 1, 0.01)]
    *angles, last = map(isoplanatic_angle_rad, paths)
    assert angles == sorted(angles)
    assert angles[1] == pytest.approx(angles[0], rel=0.02)
    assert math.isinf(last)
