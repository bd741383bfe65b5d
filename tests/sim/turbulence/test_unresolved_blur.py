"""The blur of modes that PSFs are without, against exact PSFs that hold more of them."""

import pytest
import torch

from scripts.fit_p2s.exact_psf import fraunhofer_psf
from src.sim.turbulence.unresolved_blur import (
    blur_by_phase,
    missing_structure_function,
    unresolved_structure_function,
)
from tests.sim.turbulence.theory import draw_phases, noll_residual

FINE = 79


def test_variance_is_what_noll_leaves():
    assert unresolved_structure_function()[-1] / 2 == pytest.approx(noll_residual(120), rel=0.03)


def mean_transfer(modes: int, d_over_r0: float, unresolved: float) -> torch.Tensor:
    """Return the mean transfer function at 0.1, 0.2 ... of the cut-off, along x."""
    psfs = fraunhofer_psf(
        draw_phases(200, d_over_r0, modes), lambda_over_d_px=2.0, size=FINE, pupil=FINE - 3,
        points=1, normalise_plane=True,
    )  # fmt: skip
    beyond = unresolved_structure_function() * unresolved ** (5 / 3)
    mean = blur_by_phase(psfs.mean(0), beyond, FINE)
    x = torch.arange(FINE) - FINE // 2
    nu = torch.arange(1, 5) / 10
    return torch.cos(torch.pi * nu[:, None] * x) @ mean.sum(0)


@pytest.mark.parametrize("strength", [4.0, 8.0])
def test_transfer_function_is_that_of_495_modes(strength):
    expected = mean_transfer(495, strength, 0.0)
    few, ours = (mean_transfer(119, strength, modes) for modes in (0.0, strength))
    assert (few[0] / expected[0]) > 1.03
    torch.testing.assert_close(ours, expected, rtol=0.06, atol=0.02)


def test_light_is_kept_and_stays_centred():
    point = torch.zeros(47, 47)
    point[23, 23] = 1
    beyond = unresolved_structure_function() * 6.0 ** (5 / 3)
    blurred = blur_by_phase(point, beyond, 95)
    assert blurred.argmax() == 47 * 95 + 47
    torch.testing.assert_close(blurred, blurred.flip(0, 1), atol=1e-6, rtol=0)
    assert blurred.sum() == pytest.approx(1.0, abs=0.02)
    small = blur_by_phase(point, beyond, 47)
    torch.testing.assert_close(small, blurred[24:-24, 24:-24], atol=1e-4, rtol=0)


@pytest.mark.parametrize("modes", [20, 54])
def test_kolmogorov_turbulence_lacks_what_is_beyond_the_fitted_modes(modes):
    missing = missing_structure_function(modes, 5.0, 5.0, 0.0, (1.0,))
    expected = unresolved_structure_function() * 5.0 ** (5 / 3)
    torch.testing.assert_close(torch.from_numpy(missing), torch.from_numpy(expected))


def test_with_an_outer_scale_unseen_modes_keep_their_strength():
    """Modes of whole orders beyond the network's, less what its weaker turbulence has of them."""
    high, of_all = unresolved_structure_function(9, 0.1, (1.0,)), unresolved_structure_function(9)
    assert (high[1:] / of_all[1:]).min() > 0.98
    low, of_all = unresolved_structure_function(2, 3.0, (1.0,)), unresolved_structure_function(2)
    assert (low[1:] / of_all[1:]).max() < 0.9
    missing = missing_structure_function(20, 8.0, 4.5, 1.0, (1.0,))
    assert missing[-1] > 1.5 * unresolved_structure_function()[-1] * 8.0 ** (5 / 3)
