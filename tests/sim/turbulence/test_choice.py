"""The cheapest way to compute PSFs, and waves on a lattice by both engines."""

import pytest
import torch

from src.sim.turbulence import choice
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.p2s import band_for
from src.sim.turbulence.phase import draw_waves
from src.sim.turbulence.wave_field import Field, sums, sums_cpu


def fitted(strength: float, airy: float, pixel: float, allowed: float) -> choice.Choice:
    return choice.fitted(band_for(strength), strength, airy, pixel, allowed, None)


@pytest.mark.parametrize("strength", [0.3, 1.0, 2.5, 4.0, 5.0])
@pytest.mark.parametrize("airy", [0.5, 1.3, 2.6])
@pytest.mark.parametrize("pixel", [0.02, 0.16, 0.4])
def test_errors_are_within_what_is_allowed(strength, airy, pixel):
    for allowed in (0.2, 0.26, 0.5):
        found = fitted(strength, airy, pixel, allowed)
        assert found.error_psf + found.error_pitch + found.error_kernel <= allowed + 1e-6
        assert found.kernel % 2 == 1
        assert found.pitch > 1 or found.error_pitch == 0


def test_what_cannot_be_had_is_the_least_error():
    found = fitted(10.0, 1.0, 0.16, 0.01)
    assert found.error_psf + found.error_pitch + found.error_kernel > 0.01
    assert found.network == len(band_for(10.0).networks) - 1
    assert found.pitch == 1


def test_smaller_pixels_have_their_nodes_as_far_apart():
    pitches = [fitted(2.0, 0.1 / pixel, pixel, 0.26).pitch for pixel in (0.02, 0.05, 0.1, 0.4)]
    assert pitches == sorted(pitches, reverse=True)
    assert pitches[0] >= 8
    assert pitches[-1] == 1


@pytest.mark.parametrize("pitch", [1, 3])
@pytest.mark.parametrize("columns", [30, 31])
def test_waves_are_summed_alike_by_both_engines(pitch, columns):
    path = Atmosphere(0.1, 0.5, 300.0, 0.4, 525e-9, 1e-14, 0.8).at(3.0)
    waves = draw_waves(path, 1, modes=14, waves=100, width_px=64)
    lattices = Lattice(-3, 20, pitch, 1), Lattice(2, columns, pitch, 1)
    field = Field(waves, slice(2, None), *lattices, (64, 64), torch.device("cpu"))
    amplitudes = torch.randn(2, 100, dtype=torch.complex64)
    ours = field.at_nodes(amplitudes, sums_cpu)
    torch.testing.assert_close(field.at_nodes(amplitudes, sums), ours, atol=1e-5, rtol=1e-5)
    assert ours.std() > 0.01
