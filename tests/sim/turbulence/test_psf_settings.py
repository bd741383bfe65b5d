"""The cheapest settings of PSFs."""

from types import SimpleNamespace

import pytest

from src.sim.turbulence.fidelity import choose_psf_settings
from src.sim.turbulence.p2s import find_psf_band


def fitted(strength: float, airy: float, pixel: float, allowed: float) -> SimpleNamespace:
    found = choose_psf_settings(find_psf_band(strength), strength, airy, pixel, allowed)
    return SimpleNamespace(**found)


@pytest.mark.parametrize("strength", [0.3, 1.0, 2.5, 4.0, 5.0])
@pytest.mark.parametrize("airy", [0.5, 1.3, 2.6])
@pytest.mark.parametrize("pixel", [0.02, 0.16, 0.4])
def test_errors_are_within_what_is_allowed(strength, airy, pixel):
    for allowed in (0.2, 0.26, 0.5):
        found = fitted(strength, airy, pixel, allowed)
        assert found.psf_error + found.psf_grid_error + found.psf_size_error <= allowed + 1e-6
        assert found.psf_size_px % 2 == 1
        assert found.psf_grid_pitch_px > 1 or found.psf_grid_error == 0


def test_what_cannot_be_had_is_the_least_error():
    found = fitted(10.0, 1.0, 0.16, 0.01)
    assert found.psf_error + found.psf_grid_error + found.psf_size_error > 0.01
    assert found.psf_network == len(find_psf_band(10.0).networks) - 1
    assert found.psf_grid_pitch_px == 1


def test_smaller_pixels_have_their_nodes_as_far_apart():
    pitches = [
        fitted(2.0, 0.1 / pixel, pixel, 0.26).psf_grid_pitch_px for pixel in (0.02, 0.05, 0.1, 0.4)
    ]
    assert pitches == sorted(pitches, reverse=True)
    assert pitches[0] >= 8
    assert pitches[-1] == 1
