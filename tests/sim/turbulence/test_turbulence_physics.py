"""The physics of the turbulence, check by check, numbered as in docs/simulation.md.

Closed forms are compared with what the simulator draws.  Where the expectation over the random
amplitudes can be taken exactly (a sum over the plane waves) it is, and only the draw of the waves
is sampled; tolerances come from the sample sizes and are two-sided.
"""

import math
from dataclasses import replace
from functools import cache

import pytest
import torch

from scripts.fit_p2s.exact_psf import fraunhofer_psf, noll_covariance
from src.sim import noise
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.coefficient_grid import WaveSum
from src.sim.turbulence.fidelity import mean_short_exposure_psf
from src.sim.turbulence.operator import WAVES, Turbulence
from src.sim.turbulence.p2s import FittedPSFs, load_bands_by_d_over_r0
from src.sim.turbulence.plane_waves import PlaneWaves, advect_waves, draw_plane_waves
from src.sim.turbulence.prior import unnormalised_cn2_profile
from src.sim.turbulence.psf import PSFHalo, pixel_integration_matrix
from src.sim.turbulence.short_exposure import (
    GAUSSIAN_HALF_LIGHT,
    blur_std_in_lambda_over_d,
)
from src.sim.turbulence.unresolved_blur import unresolved_structure_function
from tests.sim.turbulence.theory import (
    compute_fitted_psfs,
    draw_phases,
    isoplanatic_angle_rad,
    noll_residual,
)

LIGHT_WITHIN_24 = 0.98  # of a point's light, lambda / D
PATH = Atmosphere(0.05, 0.5, 1000.0, 2.0, 525e-9, 3e-14, 0.9)  # D 5 cm, 1 km, 2 m wide


def waves_of(atmosphere: Atmosphere, modes: int, clips: int) -> list[PlaneWaves]:
    given = {"modes": modes, "waves": WAVES, "width_px": 256}
    return [draw_plane_waves(atmosphere, noise.key(i), **given) for i in range(clips)]


def covariance(waves: PlaneWaves, shift_px: tuple[float, float] = (0.0, 0.0)) -> torch.Tensor:
    """Return E[a_i(x) a_j(x + shift)] over the amplitudes of one clip."""
    turn = 2 * math.pi * waves.frequency_per_px @ torch.tensor(shift_px, dtype=torch.float64)
    left = torch.view_as_complex(waves.response)
    right = left * torch.exp(1j * turn)
    return (left.conj() @ right.T).real


def mean_covariance(clips: list[PlaneWaves], shift_px=(0.0, 0.0)) -> torch.Tensor:
    return torch.stack([covariance(waves, shift_px) for waves in clips]).mean(0)


def still(d_over_r0: float, size: int = 32, **options) -> Turbulence:
    """Return turbulence of nine views whose frames are independent draws."""
    path = replace(PATH.with_d_over_r0(d_over_r0), ar1_coefficient=0.0)
    return Turbulence(path, views=9, height=size, width=size, **options)


def test_01_fried_parameter():
    assert PATH.r0_m == pytest.approx(0.01995, rel=0.005)
    slab = replace(PATH, cn2=(3e-14, 3e-14, 3e-14))
    assert slab.r0_m == pytest.approx(PATH.r0_m, rel=1e-9)
    near, far = replace(PATH, cn2=(6e-14, 0.0)), replace(PATH, cn2=(0.0, 6e-14))
    assert near.r0_m < PATH.r0_m < far.r0_m  # air at the lens hurts most


def test_02_03_04_noll_covariances_of_the_waves():
    clips = waves_of(PATH.with_d_over_r0(1.0), 35, 64)
    expected = noll_covariance(35)
    scale = expected.diagonal().sqrt()
    error = (mean_covariance(clips) - expected) / (scale[:, None] * scale)
    assert error.diagonal().abs().max() < 0.01
    assert error.abs().max() < 0.02
    assert expected[0, 0] == pytest.approx(0.4489, abs=1e-4)
    assert expected[0, 6] == pytest.approx(-0.01416, abs=1e-5)
    assert expected[1, 5] == pytest.approx(-0.01416, abs=1e-5)
    assert expected[2, 9] == pytest.approx(-0.00388, abs=1e-5)


def test_02_every_clip_has_the_right_tilt_variance():
    variances = [covariance(waves)[0, 0] for waves in waves_of(PATH.with_d_over_r0(1.0), 35, 32)]
    assert torch.stack(variances).std() < 0.02 * 0.4489


def test_05_residuals():
    table = [1.0324, 0.5835, 0.1347, 0.1114, 0.0882, 0.0650, 0.0588, 0.0526, 0.0464, 0.0402]
    table += [0.0378, 0.0353, 0.0329, 0.0304, 0.0280, 0.0268, 0.0256, 0.0244, 0.0232, 0.0220]
    for modes, residual in enumerate([*table, 0.0208], start=1):
        assert noll_residual(modes) == pytest.approx(residual, abs=6e-5)
    assert noll_residual(120) == pytest.approx(0.2944 * 120 ** (-math.sqrt(3) / 2), rel=0.03)


def test_06_tilt_in_pixels():
    strength = 0.05 / 0.0203
    spread = PATH.with_d_over_r0(strength).tilt_std_px(256)
    assert spread == pytest.approx(1.21, rel=0.01)
    turbulence, crop = still(strength, 256), (128, 128, 1, 1)
    runs = [turbulence.tilt(100, noise.generator(seed), crop=crop) for seed in range(12)]
    samples = torch.stack(runs)  # 12 x 9 x 100 x 2 draws
    tolerance = 4 / math.sqrt(2 * samples.numel()) + 0.005
    assert samples.square().mean().sqrt() == pytest.approx(spread, rel=tolerance)
    assert samples.abs().max() > 3 * spread


def test_07_centroid_of_a_rendered_point():
    path = replace(PATH.with_d_over_r0(1.0), ar1_coefficient=0.0, scene_width_m=0.5)
    turbulence = Turbulence(path, views=9, height=65, width=65)
    bell = torch.exp(-((torch.arange(65.0) - 32) ** 2) / 8)  # smooth, so that the warp is exact
    point = (bell[:, None] * bell).expand(1, 16, -1, -1)
    seen = turbulence.degrade(point, noise.generator(0))[0].flatten(0, 1)
    seen = seen / seen.sum((1, 2), keepdim=True)
    place = torch.arange(65.0) - 32
    x, y = (seen.sum(1) * place).sum(1), (seen.sum(2) * place).sum(1)
    share = 0.5 * (x.var() + y.var()) / turbulence.fidelity.lambda_over_d_px**2
    slack = 4 * share * math.sqrt(2 / (2 * len(x)))
    assert 0.1698 - slack < share < 0.1819 + slack  # between G-tilt and Z-tilt
    drawn = turbulence.tilt(16, noise.generator(0), crop=(32, 32, 1, 1))
    same = torch.corrcoef(torch.stack([x, drawn.flatten(0, 1)[:, 0, 0, 0]]))[0, 1]
    assert same > 0.9  # the light goes where the tilt says


@pytest.mark.parametrize(
    "mode, expected",
    [
        (4, (0.945, 0.865, 0.666, 0.471, 0.293)),
        (11, (0.859, 0.705, 0.434, 0.254, 0.136)),
        (2, (0.993, 0.978, 0.929, 0.860, 0.766)),
    ],
)
def test_08_correlation_along_the_object(mode, expected):
    clips = waves_of(PATH.with_d_over_r0(1.0), 14, 200)
    pixel = PATH.pixel_size_at_object_m(256) / PATH.aperture_m
    zero = mean_covariance(clips)
    for separation, value in zip((0.1, 0.2, 0.5, 1.0, 2.0), expected, strict=True):
        along = mean_covariance(clips, (separation / pixel, 0.0))
        across = mean_covariance(clips, (0.0, separation / pixel))
        found = (along + across)[mode - 2, mode - 2] / (2 * zero[mode - 2, mode - 2])
        assert found == pytest.approx(value, abs=0.02)


def test_09_tilt_along_and_across_the_separation():
    clips = waves_of(PATH.with_d_over_r0(1.0), 2, 200)
    along = mean_covariance(clips, (128.0, 0.0))  # 20 D apart
    across = mean_covariance(clips, (0.0, 128.0))
    # Sarazin & Roddier 1990: 0.0968 against 0.145 (d/D)^(-1/3) beyond a few D, in any layer
    assert along[0, 0] / across[0, 0] == pytest.approx(0.0968 / 0.145, abs=0.05)
    assert across[1, 1] / along[1, 1] == pytest.approx(0.0968 / 0.145, abs=0.05)


@pytest.mark.parametrize("tilt", [True, False], ids=["10_long", "11_short"])
def test_exposure_transfer_function(tilt):
    size, airy, strength = 63, 2.0, 2.0
    flat = torch.zeros(1, 2)
    psfs_of_band = fraunhofer_psf(
        draw_phases(1500, strength, 90, tilt), lambda_over_d_px=airy, size=size, points=1
    )
    limit = fraunhofer_psf(flat, lambda_over_d_px=airy, size=size, points=1)

    def transfer(psf):
        total = torch.fft.fft2(psf.mean(0)).abs()
        return (total[0] + total[:, 0]) / 2

    found = transfer(psfs_of_band) / transfer(limit)
    # Fried's short exposure takes tilt and the rest for independent; a lower bound as nu grows
    for index in (6, 12, 18) if tilt else (3, 6):
        nu = index / size * airy  # in D / lambda
        lost = 3.44 * (strength * nu) ** (5 / 3) * (1 if tilt else 1 - nu ** (1 / 3))
        assert found[index] == pytest.approx(math.exp(-lost), abs=0.035)


@pytest.mark.parametrize("strength, strehl", [(1.0, 0.88), (2.0, 0.68), (4.0, 0.39), (6.0, 0.24)])
def test_12_mean_peak(strength, strehl):
    psfs_of_band = fraunhofer_psf(
        draw_phases(1200, strength, 35), lambda_over_d_px=4.0, size=61, points=1
    )
    limit = fraunhofer_psf(torch.zeros(1, 35), lambda_over_d_px=4.0, size=61, points=1)
    peak = psfs_of_band.amax((1, 2)).mean() / limit.max()
    assert peak == pytest.approx(strehl, rel=0.06)


@cache
def integrate_over_fifths(size: int) -> torch.Tensor:
    return pixel_integration_matrix(5 * size, size, 0.2)


def radius_of_half_the_light(psf: torch.Tensor, samples: float) -> float:
    """Return it in lambda / D, of a PSF of `samples` per lambda / D that holds all light but what
    diffraction and turbulence send beyond 24 lambda / D."""
    fine = integrate_over_fifths(len(psf))
    light, edge = fine @ psf.double() @ fine.T, len(fine) // 2
    x = (torch.arange(len(fine)) - edge) * 0.2 / samples
    held, order = torch.hypot(x[:, None], x).flatten().sort()
    inside = LIGHT_WITHIN_24 * light.flatten()[order].cumsum(0) / light.sum()
    return float(held[int(torch.searchsorted(inside, 0.5))])


def blur_beyond_diffraction(psf: torch.Tensor, sharp: torch.Tensor, samples: float) -> float:
    radii = [radius_of_half_the_light(one, samples) for one in (psf, sharp)]
    return math.sqrt(max(radii[0] ** 2 - radii[1] ** 2, 0)) / GAUSSIAN_HALF_LIGHT


@pytest.mark.parametrize(
    "strength, known", [(1.0, 1.02), (2.0, 1), (3.0, 1), (4.0, 1), (6.0, 1), (10.0, 1)]
)
def test_12_blur_beyond_diffraction(strength, known):
    psf, sharp = (
        mean_short_exposure_psf(d, unresolved_structure_function() * d ** (5 / 3))
        for d in (strength, 0.001)
    )
    ratio = blur_beyond_diffraction(psf, sharp, 2.0) / blur_std_in_lambda_over_d(strength)
    print(f"D/r0 {strength:g}: blur {ratio:.2f} of theory")
    assert ratio == pytest.approx(known, abs=0.04)


def mean_simulated_psf(turbulence: Turbulence, clips: int) -> torch.Tensor:
    """Return the mean of 40 PSFs of one pixel in every clip, tilt removed, with their halo."""
    phases = []
    for seed in range(clips):
        [plan] = turbulence.plan(40, noise.generator(seed), (60, 60, 1, 1))
        tables = plan.tables.to(torch.device("cpu"))
        waves = WaveSum(*(tables[f"psf_{name}"] for name in ("response", "rows", "columns")), 2)
        phases.append(waves(plan.amplitudes)[..., 0, 0])
    fitted, strength = turbulence.psfs, turbulence.fidelity.blur_equivalent_d_over_r0
    psfs = compute_fitted_psfs(fitted, torch.cat(phases, 1), strength)
    mean, kernel = turbulence.halo.psf.clone(), fitted.basis.shape[-1]
    first = (len(mean) - kernel) // 2
    inside = slice(first, first + kernel)
    mean[inside, inside] += psfs.mean(1).unflatten(0, (kernel, kernel))
    return mean


@pytest.mark.parametrize(
    "outer_scale, strength, tolerance, known",
    [
        (math.inf, 2.0, 1.0, 1.03),
        (math.inf, 4.0, 0.26, 1.0),
        (math.inf, 8.0, 0.26, 1.0),
        (3.0, 4.0, 1.0, 1.0),
        (3.0, 8.0, 0.26, 1.0),
        (1.0, 2.0, 1.0, 0.94),
        (1.0, 4.0, 1.0, 1.04),
        (1.0, 8.0, 0.26, 1.0),
    ],
)
def test_12_blur_with_an_outer_scale(outer_scale, strength, tolerance, known):
    """Of the mean of 1,600 simulated PSFs by networks of many modes and of few."""
    path = replace(PATH, cn2=unnormalised_cn2_profile("camera"), ar1_coefficient=0.0)
    path = replace(path, outer_scale_m=outer_scale * path.aperture_m).with_d_over_r0(strength)
    wide = path.scene_width_m * path.lambda_over_d_px(128) / 4  # 4 px per lambda / D
    path = replace(path, scene_width_m=wide)
    degraded, still = (
        Turbulence(one, views=1, height=128, width=128, tolerance=tolerance)
        for one in (path, path.with_d_over_r0(0.001))
    )
    psf = mean_simulated_psf(degraded, 40)
    sharp = mean_simulated_psf(still, 1)  # there is next to nothing to draw
    theory = blur_std_in_lambda_over_d(strength, *path.outer_scale_and_profile)
    ratio = blur_beyond_diffraction(psf, sharp, 4.0) / theory
    modes = degraded.fidelity.zernike_modes
    print(f"L0 {outer_scale:g} D, D/r0 {strength:g}, {modes} modes: blur {ratio:.2f} of theory")
    assert ratio == pytest.approx(known, abs=0.03)


def test_13_isoplanatic_angle():
    reach = isoplanatic_angle_rad(PATH) * PATH.distance_m
    assert reach == pytest.approx(0.314 * PATH.r0_m, rel=0.003)


def test_14_ar1():
    path = replace(PATH.with_d_over_r0(2.0), ar1_coefficient=0.8)
    turbulence = Turbulence(path, views=9, height=32, width=32)
    crop = (16, 16, 1, 1)
    runs = [turbulence.tilt(60, noise.generator(seed), crop=crop) for seed in range(10)]
    tilt = torch.stack(runs).flatten(0, 1)[..., 0, 0] / path.tilt_std_px(32)
    for lag in (1, 2, 5):
        found = (tilt[:, lag:] * tilt[:, :-lag]).mean()
        assert found == pytest.approx(0.8**lag, abs=0.12)
    first = tilt[:, 0].square().mean()  # 10 x 9 x 2 draws
    assert first == pytest.approx(1.0, abs=4 * math.sqrt(2 / 180))
    assert torch.equal(runs[3], turbulence.tilt(60, noise.generator(3), crop=crop))


def test_14_ar1_at_another_frame_rate_has_the_same_time_scale():
    path = replace(PATH.with_d_over_r0(2.0), ar1_coefficient=0.8)
    slow = Turbulence(path, views=9, height=32, width=32, fps=120.0)
    fast = Turbulence(path, views=9, height=32, width=32, fps=480.0)
    change = []
    for turbulence, step in ((slow, 1), (fast, 4)):
        tilt = turbulence.tilt(240 * step, noise.generator(0), crop=(9, 9, 1, 1))[:, ::step]
        change.append((tilt[:, 1:] - tilt[:, :-1]).square().mean())
    assert change[0] == pytest.approx(float(change[1]), rel=0.15)


def test_15_frozen_flow_shifts_the_field():
    [waves] = waves_of(PATH.with_d_over_r0(2.0), 9, 1)
    middle = torch.full_like(waves.z_over_l, 0.5)
    pixel = PATH.pixel_size_at_object_m(256)
    thin = replace(waves, z_over_l=middle, frequency_per_px=waves.frequency_per_m * 0.5 * pixel)
    fresh = torch.randn(1, 1, WAVES, 2, dtype=torch.float64)
    speed, seconds = torch.tensor([[2.0, -1.0]], dtype=torch.float64), 0.01
    later = advect_waves(thin, fresh, speed, torch.tensor([seconds], dtype=torch.float64))[0, 0]
    # a layer half-way moves v t; the object point behind the same air moves 2 v t the same way
    shift = speed[0] * seconds / 0.5 / pixel
    response = torch.view_as_complex(thin.response)
    at = torch.tensor([7.0, 3.0], dtype=torch.float64)
    now = (response * later * torch.exp(2j * math.pi * (thin.frequency_per_px @ at))).real.sum(1)
    before = torch.view_as_complex(fresh)[0, 0] * torch.exp(
        2j * math.pi * (thin.frequency_per_px @ (at - shift))
    )
    torch.testing.assert_close(now, (response * before).real.sum(1))


def test_15_tilt_spectrum_of_frozen_flow():
    waves = draw_plane_waves(PATH.with_d_over_r0(1.0), 5, modes=2, waves=200_000, width_px=256)
    near = replace(waves, z_over_l=torch.zeros_like(waves.z_over_l))
    kappa_x = (near.frequency_per_m[:, 0].abs() * PATH.aperture_m * (1 - waves.z_over_l)).log10()
    power = near.response[0].square().sum(-1)

    def density(low: float, high: float) -> float:
        inside = (kappa_x > low) & (kappa_x <= high)
        return math.log10(float(power[inside].sum()) / (10**high - 10**low))

    slope = (density(-2.0, -1.8) - density(-3.0, -2.8)) / 1.0
    assert slope == pytest.approx(-2 / 3, abs=0.15)
    steep = (density(0.9, 1.0) - density(0.5, 0.6)) / 0.4
    assert steep == pytest.approx(-17 / 3, abs=0.8)  # Conan et al. 1995


def test_16_psf_energy():
    coefficients = draw_phases(200, 4.0, 44)
    exact = fraunhofer_psf(coefficients, lambda_over_d_px=1.0, size=17)
    torch.testing.assert_close(exact.sum((1, 2)), torch.ones(200), atol=1e-5, rtol=0)
    assert exact.min() >= 0
    for band in load_bands_by_d_over_r0():
        coefficients = draw_phases(200, band.max_d_over_r0, 119)
        psfs_of_band = FittedPSFs(band, -1, len(band.basis), 1.0, 15)
        phase = coefficients[:, 2 : psfs_of_band.network.modes].T
        psfs = compute_fitted_psfs(psfs_of_band, phase, band.max_d_over_r0)
        assert psfs.min() >= 0
        found = psfs.sum(0).flatten()
        sizes = {"lambda_over_d_px": 1.0, "size": 15, "normalise_plane": True}
        inside = fraunhofer_psf(coefficients, **sizes).sum((1, 2))
        assert inside.max() < 1.001
        torch.testing.assert_close(found, inside, atol=0.15, rtol=0)
        beyond = unresolved_structure_function() * band.max_d_over_r0 ** (5 / 3)
        all_modes = FittedPSFs(band, -1, len(band.basis), 1.0, 15, beyond)
        kernel = compute_fitted_psfs(all_modes, phase, band.max_d_over_r0).sum(0).mean()
        halo = PSFHalo(mean_short_exposure_psf(band.max_d_over_r0, beyond), 1.0, 15).share
        assert kernel + halo == pytest.approx(1.0, abs=0.03)  # cut of negative light, far light


def test_17_zero_turbulence_is_diffraction_and_moves_nothing():
    image = torch.rand(1, 1, 64, 64, generator=noise.generator(0))
    wide = replace(PATH, scene_width_m=40.0)  # a pixel far wider than lambda / D
    tiny = wide.with_d_over_r0(1e-6)
    turbulence = Turbulence(tiny, views=1, height=64, width=64)
    assert turbulence.fidelity.psf_size_px == 1
    assert (turbulence.degrade(image, torch.Generator()) - image[:, None]).abs().max() < 1e-4
    point = torch.zeros(1, 1, 65, 65)
    point[..., 32, 32] = 1
    sharp = Turbulence(PATH.with_d_over_r0(1e-6), views=1, height=65, width=65)
    airy = sharp.degrade(point, torch.Generator())[0, 0, 0]
    torch.testing.assert_close(airy, airy.flip(0), atol=2e-3, rtol=0)
    torch.testing.assert_close(airy, airy.flip(1), atol=2e-3, rtol=0)


def test_18_views_are_independent():
    tilt = still(2.0, 64).tilt(1500, noise.generator(2), crop=(32, 32, 1, 1))
    correlation = torch.corrcoef(tilt[:, :, 0, 0, 0])
    off = correlation - torch.eye(9)
    assert off.abs().max() < 4.5 / math.sqrt(1500)


def test_18_views_on_a_baseline_are_partly_correlated():
    both = (still(2.0, views_correlation="baseline", baseline_m=far) for far in (0.01, 0.2))
    tilts = (one.tilt(400, noise.generator(2), crop=(16, 16, 1, 1)) for one in both)
    close, apart = (torch.corrcoef(tilt[:, :, 0, 0, 0])[0] for tilt in tilts)
    assert 0.9 < close[1] < 1
    assert apart[2] < apart[1] < close[1]
    assert apart[1] > 0.2


def test_19_opposite_borders_are_not_locked_together():
    turbulence, crop = still(2.0, 256), (128, 0, 1, 256)  # 40 D wide
    tilts = [turbulence.tilt(50, noise.generator(seed), crop=crop) for seed in range(8)]
    pairs = [tilt[:, :, 1, 0].flatten(0, 1)[:, [0, 128, 255]] for tilt in tilts]
    correlation = torch.corrcoef(torch.cat(pairs).T)
    clips = waves_of(PATH.with_d_over_r0(2.0), 2, 100)
    zero = mean_covariance(clips)[1, 1]
    half, full = (mean_covariance(clips, (shift, 0.0))[1, 1] / zero for shift in (128.0, 255.0))
    assert correlation[0, 1] == pytest.approx(float(half), abs=0.08)
    assert correlation[0, 2] == pytest.approx(float(full), abs=0.08)
    assert full < half < 0.6


def test_20_rytov_variance():
    strong = replace(PATH, cn2=1e-13)
    k = 2 * math.pi / 525e-9
    expected = 0.5 * 1e-13 * k ** (7 / 6) * 1000 ** (11 / 6)
    assert strong.rytov_variance == pytest.approx(expected, rel=0.01)
    assert strong.rytov_variance > 2.5


def test_21_scaling():
    twice = replace(PATH, wavelength_m=1050e-9)
    assert twice.r0_m == pytest.approx(PATH.r0_m * 2 ** (6 / 5), rel=1e-9)
    assert twice.tilt_std_px(256) == pytest.approx(PATH.tilt_std_px(256), rel=1e-9)
    weak, strong = (waves_of(PATH.with_d_over_r0(d), 9, 1)[0] for d in (1.0, 8.0))
    torch.testing.assert_close(strong.response, weak.response * 8 ** (5 / 6))
