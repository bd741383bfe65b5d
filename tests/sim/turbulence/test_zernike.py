"""Noll's modes: order, values, spectra."""

import math

import torch

from scripts.fit_p2s.exact_psf import noll_covariance, zernike_basis
from src.sim.turbulence.zernike import noll_index, pupil_filter


def test_order_of_the_modes():
    expected = [(0, 0), (1, 1), (1, -1), (2, 0), (2, -2), (2, 2), (3, -1), (3, 1), (3, -3), (3, 3)]
    assert [noll_index(mode) for mode in range(1, 11)] == expected
    assert noll_index(36) == (7, 7)


def test_modes_are_orthonormal_over_the_pupil():
    values, _ = zernike_basis(35, 256)
    gram = values @ values.T / values.shape[1]
    torch.testing.assert_close(gram, torch.eye(35, dtype=torch.float64), atol=0.01, rtol=0)


def test_tilt_and_defocus_point_the_right_way():
    values, points = zernike_basis(3, 64)
    torch.testing.assert_close(values[0], 2 * points[:, 0])
    torch.testing.assert_close(values[1], 2 * points[:, 1])
    torch.testing.assert_close(values[2], math.sqrt(3) * (2 * points.square().sum(1) - 1))


def test_filter_is_the_transform_of_the_mode():
    kappa, angle = torch.tensor([0.0, 0.7, 1.9, 4.2]), torch.tensor([0.3, 0.4, 2.1, -1.0])
    values, points = zernike_basis(35, 512)
    frequency = torch.stack([kappa * angle.cos(), kappa * angle.sin()], -1).double()
    wave = torch.exp(1j * math.pi * (points @ frequency.T))
    numeric = values.to(wave.dtype) @ wave / values.shape[1]
    exact = torch.view_as_complex(pupil_filter(kappa, angle, 35))
    torch.testing.assert_close(exact, numeric, atol=2e-3, rtol=0)


def test_covariance_is_symmetric_positive_and_sparse():
    covariance = noll_covariance(119)
    assert torch.equal(covariance, covariance.T)
    assert torch.linalg.eigvalsh(covariance)[0] > 0
    assert covariance[0, 1] == 0
    assert covariance[2, 4] == 0
