"""The blur of modes beyond Noll 120 against exact PSFs that hold more of them."""

import pytest
import torch

from scripts.exact_psf import fraunhofer_psf
from src.sim.turbulence.unresolved_blur import (
    blur_by_unresolved_modes,
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
    mean = blur_by_unresolved_modes(psfs.mean(0), unresolved, FINE)
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
    blurred = blur_by_unresolved_modes(point, 6.0, 95)
    assert blurred.argmax() == 47 * 95 + 47
    torch.testing.assert_close(blurred, blurred.flip(0, 1), atol=1e-6, rtol=0)
    assert blurred.sum() == pytest.approx(1.0, abs=0.02)
    small = blur_by_unresolved_modes(point, 6.0, 47)
    torch.testing.assert_close(small, blurred[24:-24, 24:-24], atol=1e-4, rtol=0)
