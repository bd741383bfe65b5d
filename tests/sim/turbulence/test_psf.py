"""Point spread functions: the exact one, its resampling, and the fitted one against it."""

import math

import pytest
import torch

from scripts.fit_p2s.errors import exact_psfs
from scripts.fit_p2s.exact_psf import fraunhofer_psf
from src.sim.turbulence.p2s import (
    FILE,
    FittedPSFs,
    basis_parities,
    find_psf_band,
    load_bands_by_d_over_r0,
)
from src.sim.turbulence.psf import pixel_integration_matrix
from tests.sim.turbulence.theory import compute_fitted_psfs, draw_phases

MODES = 119  # that carry what blurs


def test_clear_pupil_is_airys_pattern():
    psf = fraunhofer_psf(torch.zeros(2), lambda_over_d_px=4.0, size=61, points=1, pupil=256)
    profile = psf[30, 30:] / psf[30, 30]
    x = math.pi * torch.arange(31.0) / 4
    airy = (2 * torch.special.bessel_j1(x) / x.clamp(min=1e-9)) ** 2
    airy[0] = 1
    torch.testing.assert_close(profile, airy, atol=2e-3, rtol=0)


def test_tilt_moves_the_light_the_way_it_says():
    tilt = torch.tensor([1.5, -0.8])
    psf = fraunhofer_psf(tilt, lambda_over_d_px=2.0, size=63, points=1)
    straight = fraunhofer_psf(torch.zeros(2), lambda_over_d_px=2.0, size=63, points=1)
    moved = psf.flatten().argmax()
    assert moved % 63 - 31 == round(1.5 * 4 / math.pi)
    assert moved // 63 - 31 == round(-0.8 * 4 / math.pi)
    assert straight.argmax() == 31 * 63 + 31


@pytest.mark.parametrize("airy", [0.5, 0.7, 1.0, 2.0])
def test_resampling_equals_integration_over_pixels(airy):
    size = 2 * int(4 * airy) + 1
    coefficients = draw_phases(8, 2.0, 35)
    fine = fraunhofer_psf(coefficients, lambda_over_d_px=2.0, size=65, pupil=64, points=1)
    grid = pixel_integration_matrix(size, 65, 2.0 / airy).float()
    ours = grid @ fine @ grid.T
    exact = fraunhofer_psf(coefficients, lambda_over_d_px=airy, size=size, pupil=64, points=9)
    ours = ours / ours.sum((1, 2), keepdim=True)
    assert (ours - exact).norm() < 0.01 * exact.norm()


def exact_and_fitted(strength: float, number: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Return PSFs (300, fine^2) of all modes, and what network `number` makes of its own."""
    band = find_psf_band(strength)
    coefficients = draw_phases(300, strength, MODES)
    size = band.mean.shape[-1]
    exact = exact_psfs(coefficients, size)
    network = band.networks[number]
    merged = network.merge_into_few_matrices(network.modes - 2, strength)
    weights = merged(coefficients[:, 2:].T)[1:].T
    basis = band.basis[basis_parities(band.basis).argsort(stable=True)]
    return exact.flatten(1), band.mean.flatten() + weights @ basis.flatten(1)


def relative(error: torch.Tensor, truth: torch.Tensor) -> float:
    return float((error.norm(dim=1) / truth.norm(dim=1)).square().mean().sqrt())


@pytest.mark.parametrize("strength, limit", [(1.0, 0.05), (2.0, 0.12), (4.0, 0.3)])
def test_fitted_psf_is_close_to_the_exact_one(strength, limit):
    exact, ours = exact_and_fitted(strength, -1)
    assert relative(ours - exact, exact) < limit


@pytest.mark.parametrize("number", [0, 1, 2])
@pytest.mark.parametrize("strength", [0.3, 1.0, 1.5, 3.0, 6.0, 10.0])
def test_modes_left_out_blur_as_they_do_on_average(strength, number):
    exact, ours = exact_and_fitted(strength, number)
    spread = (exact - exact.mean(0)).square().sum(1).mean()
    assert (ours.mean(0) - exact.mean(0)).square().sum() < 0.02 * spread


def test_basis_is_even_or_odd_under_both_mirrors():
    for band in load_bands_by_d_over_r0():
        for axis in (1, 2):
            turned = band.basis.flip(axis)
            sign = (turned * band.basis).sum((1, 2), keepdim=True).sign()
            assert (turned * sign - band.basis).abs().max() < 2e-3 * band.basis.abs().max()


def test_fitted_psf_without_phase_is_diffraction():
    psfs = FittedPSFs(load_bands_by_d_over_r0()[0], -1, 24, 1.0, 17)
    ours = compute_fitted_psfs(psfs, torch.zeros(25, 1), 0.0).reshape(17, 17)
    exact = fraunhofer_psf(torch.zeros(2), lambda_over_d_px=1.0, size=17, points=9)
    assert (ours - exact).abs().max() < 0.01 * exact.max()


def test_the_fitted_file_is_small():
    assert FILE.stat().st_size < 2_000_000


@pytest.mark.slow
def test_we_are_closer_than_the_public_network(shared_data):
    """Relative error at D/r0 = 4, at the sampling of the public basis (3.8 pixels a lambda / D)."""
    state = torch.load(shared_data / "p2s_reference/P2S_state.pt", map_location="cpu")
    known = torch.load(shared_data / "p2s_reference/kernel_PCA.pt", map_location="cpu")
    coefficients = draw_phases(300, 4.0, MODES)
    exact = fraunhofer_psf(coefficients, lambda_over_d_px=3.8, size=65, pupil=64, points=1)
    exact = exact.flatten(1)
    layers = list(state.values())
    x = coefficients[:, 2:35]
    for index in (0, 2, 4):
        x = torch.nn.functional.linear(x, layers[index], layers[index + 1])
        x = torch.nn.functional.leaky_relu(x, 0.01) if index < 4 else x
    public = known["mu"].reshape(1, -1) + x @ known["dictionary"].reshape(len(x.T), -1)
    band = find_psf_band(4.0)
    psfs = FittedPSFs(band, -1, len(band.basis), 3.8, 65)
    ours = compute_fitted_psfs(psfs, coefficients[:, 2 : psfs.network.modes].T, 4.0).T

    def error(psf):
        psf, truth = (p / p.sum(1, keepdim=True) for p in (psf, exact))
        return relative(psf - truth, truth)

    print(f"public {error(public):.3f}, ours {error(ours):.3f}")
    assert error(ours) < 0.5 * error(public)
