"""Turbulence as an operator: its laws, its accuracy, its limits."""

import math
from dataclasses import replace

import pytest
import torch

from src.sim.turbulence import Atmosphere
from src.sim.turbulence.coefficient_grid import GridAxis
from src.sim.turbulence.fidelity import mean_short_exposure_psf
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.psf import PSFHalo, convolve_halo
from src.sim.turbulence.unresolved_blur import unresolved_structure_function
from tests.sim.turbulence.theory import degrade_with_exact_psfs

PATH = Atmosphere(0.1, 0.5, 300.0, 0.4, 525e-9, 1e-14, 0.8)


def seed(number: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(number)


def leaves(size: int) -> torch.Tensor:
    """Return opaque discs of many sizes (size, size): edges and spectrum as in nature."""
    generator = seed(4)
    y, x = torch.meshgrid(torch.arange(size), torch.arange(size), indexing="ij")
    picture = torch.full((size, size), 0.5)
    for _ in range(600):
        u = torch.rand(4, generator=generator)
        radius = 2 + (u[0] * (1 / 4 - 1 / 3600) + 1 / 3600) ** -0.5
        picture[(x - u[1] * size) ** 2 + (y - u[2] * size) ** 2 < radius**2] = 0.1 + 0.8 * u[3]
    return picture


def shine(halo: PSFHalo, frames: torch.Tensor, window) -> torch.Tensor:
    sources = halo.sources_and_spectrum(frames.shape[1:], window)
    return convolve_halo(frames, *sources, window[2:])[0]


def operator(d_over_r0: float, views=1, size: int = 64, width_m: float = 0.1, **options):
    path = replace(PATH, scene_width_m=width_m).with_d_over_r0(d_over_r0)
    return Turbulence(path, views=views, height=size, width=size, **options)


def test_shapes_and_dtype():
    seen = operator(2.0, views=4).degrade(torch.rand(2, 3, 64, 64), seed())
    assert seen.shape == (2, 4, 3, 64, 64)
    assert seen.dtype == torch.float32


@pytest.mark.parametrize("path", [None, PATH.with_d_over_r0(0.0)], ids=["none", "no Cn2"])
def test_no_turbulence_is_the_identity_and_free(path):
    frames = torch.rand(2, 3, 16, 24)
    turbulence = Turbulence(path, views=9, height=16, width=24)
    seen = turbulence.degrade(frames, seed())
    assert torch.equal(seen, frames[:, None].expand(-1, 9, -1, -1, -1))
    assert seen.data_ptr() == frames.data_ptr()
    part = turbulence.degrade(frames, seed(), crop=(2, 3, 8, 9))
    assert torch.equal(part, seen[..., 2:10, 3:12])
    assert turbulence.tilt(3, seed()).abs().max() == 0


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
def test_law_2_single_is_the_centre_view_bit_for_bit(strength):
    frames = torch.rand(1, 3, 64, 64)
    nine = operator(strength, views=9).degrade(frames, seed())
    one = operator(strength, views=[(0, 0)]).degrade(frames, seed())
    assert torch.equal(nine[:, 4:5], one)


def test_law_3_a_view_does_not_depend_on_its_company():
    frames = torch.rand(1, 2, 64, 64)
    nine = operator(2.0, views=9).degrade(frames, seed())
    two = operator(2.0, views=[(1, 1), (-1, 0)]).degrade(frames, seed())
    assert torch.equal(two, nine[:, [8, 1]])


def test_law_3_a_frame_does_not_depend_on_later_ones():
    frames = torch.rand(1, 6, 64, 64)
    turbulence = operator(2.0)
    whole = turbulence.degrade(frames, seed())
    torch.testing.assert_close(turbulence.degrade(frames[:, :2], seed()), whole[:, :, :2])


@pytest.mark.parametrize("strength", [0.5, 4.0])
def test_any_number_of_threads_gives_the_same_bits(strength):
    frames, turbulence = torch.rand(1, 3, 64, 64), operator(strength, views=4)
    before, seen = torch.get_num_threads(), []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            seen.append(turbulence.degrade(frames, seed()))
            assert torch.get_num_threads() == count
        with torch.inference_mode():  # as in validation; threads have modes of their own
            seen.append(turbulence.degrade(frames, seed()))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(seen[0], other) for other in seen[1:])


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
@pytest.mark.parametrize("crop", [(0, 0, 32, 40), (17, 9, 33, 48), (63, 63, 1, 1)])
def test_law_5_a_crop_is_the_crop_of_the_whole(strength, crop):
    frames = torch.rand(1, 2, 64, 64)
    turbulence = operator(strength, views=4)
    top, left, height, width = crop
    whole = turbulence.degrade(frames, seed())[..., top : top + height, left : left + width]
    part = turbulence.degrade(frames, seed(), crop=crop)
    torch.testing.assert_close(part, whole, atol=2e-5, rtol=0)


@pytest.mark.parametrize("strength", [1e-6, 1.0, 4.0, 9.0])
def test_law_7_flat_stays_flat(strength):
    seen = operator(strength, views=4).degrade(torch.full((1, 2, 64, 64), 0.6), seed())
    assert (seen - 0.6).abs().max() < 1e-5


def test_what_the_views_see_differs_and_moves():
    frames = leaves(64).expand(1, 2, -1, -1)
    seen = operator(4.0, views=4).degrade(frames, seed())[0]
    assert (seen[0] - seen[1]).abs().mean() > 0.01
    assert (seen[:, 0] - seen[:, 1]).abs().mean() > 0.005
    assert seen.min() >= 0
    assert seen.max() <= 1.0001


@pytest.mark.parametrize("temporal_model", ["ar1", "frozen_flow"])
@pytest.mark.parametrize("views_correlation", ["independent", "baseline"])
def test_every_model_of_time_and_views(temporal_model, views_correlation):
    models = {"temporal_model": temporal_model, "views_correlation": views_correlation}
    turbulence = operator(2.0, 4, **models)
    tilt = turbulence.tilt(8, seed(), crop=(5, 5, 4, 4))
    assert tilt.isfinite().all()
    assert (tilt[:, 0] - tilt[:, 7]).abs().max() > 1e-3
    assert (tilt[0] - tilt[3]).abs().max() > 1e-3


def test_wind_moves_the_field_smoothly():
    turbulence = operator(2.0, 9, temporal_model="frozen_flow", fps=4000.0)
    tilt = turbulence.tilt(50, seed(), crop=(32, 32, 1, 1))[..., 0, 0]
    first, second = tilt[:, 1:] - tilt[:, :-1], tilt[:, 2:] - 2 * tilt[:, 1:-1] + tilt[:, :-2]
    assert second.square().mean() < 0.1 * first.square().mean()  # AR(1) gives about 3


LEAST_DB = {40: (51.5, 47.2, 43.3, 39.5), 80: (50.0, 45.0, 42.0, 38.0)}  # the middle has less error


@pytest.mark.parametrize("strength", [1.0, 2.0, 4.0, 6.0])
@pytest.mark.parametrize(
    "pixel, side",
    [(0.04, 40), *(pytest.param(d, 80, marks=pytest.mark.slow) for d in (0.04, 0.16, 0.4))],
)
def test_accuracy_against_exact_psfs_at_every_pixel(strength, pixel, side):
    """The middle of 128 x 128, lambda / D one pixel, a pixel of 0.04 to 0.4 D; normalised scatter
    by both.

    The exact PSFs hold all modes that matter, of the same waves.
    """
    distance = pixel * 0.1**2 / 525e-9
    path = replace(PATH, distance_m=distance, scene_width_m=128 * pixel * 0.1)
    path = path.with_d_over_r0(strength)
    turbulence = Turbulence(path, views=1, height=128, width=128)
    turbulence.fidelity = replace(turbulence.fidelity, zernike_modes=119)
    beyond = unresolved_structure_function() * strength ** (5 / 3)
    mean = mean_short_exposure_psf(strength, beyond)[24:-24, 24:-24]  # none beyond the exact PSFs
    turbulence.halo = PSFHalo(mean, 1.0, turbulence.fidelity.psf_size_px)
    assert PSFHalo(mean, 1.0, 23).share == 0
    picture, crop = leaves(128), (64 - side // 2, 64 - side // 2, side, side)
    seen = turbulence.degrade(picture[None, None], seed(3), crop=crop)[0, 0, 0]
    exact = degrade_with_exact_psfs(turbulence, picture, seed(3), crop, 23)
    error = (seen - exact).square().mean()
    found = -10 * math.log10(error)
    name = f"pixel {pixel} D, D/r0 {strength}, {side} x {side}"
    print(f"{name}: {found:.1f} dB")  # for the docs, those of 80 x 80: pytest -rP
    assert found > dict(zip((1.0, 2.0, 4.0, 6.0), LEAST_DB[side], strict=True))[strength]
    stated = turbulence.fidelity.simulation_error
    assert error.sqrt() < stated * picture.std()


def test_fidelity_follows_the_scene():
    weak, strong = operator(0.5).fidelity, operator(6.0).fidelity
    assert weak.zernike_modes < strong.zernike_modes
    assert weak.psf_rank < strong.psf_rank
    assert weak.psf_grid_pitch_px > strong.psf_grid_pitch_px
    loose, tight = (operator(2.0, tolerance=t).fidelity for t in (0.9, 0.1))
    assert loose.zernike_modes < tight.zernike_modes
    assert loose.psf_grid_pitch_px > tight.psf_grid_pitch_px
    assert loose.simulation_error > tight.simulation_error
    for fidelity in (weak, strong, tight):
        parts = (fidelity.psf_error, fidelity.psf_grid_error, fidelity.psf_size_error)
        assert all(math.isfinite(part) and part >= 0 for part in parts)


@pytest.mark.parametrize("order", [1, 3])
def test_interpolation_reproduces_straight_lines(order):
    lattice = GridAxis(-7, 30, 4, order)
    line = lattice.interpolation_matrix() @ lattice.node_pixels.float()
    torch.testing.assert_close(line, torch.arange(-7.0, 23.0))


@pytest.mark.parametrize("strength", [1e-6, 0.1, 3.0, 10.0, 10.6])
def test_any_strength_is_finite(strength):
    seen = operator(strength, size=24, width_m=0.05).degrade(torch.rand(1, 1, 24, 24), seed())
    assert seen.isfinite().all()
    assert seen.min() >= 0
    assert seen.max() <= 1.0001


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (33, 2), (7, 7)])
def test_any_size_is_finite(size):
    path = replace(PATH, scene_width_m=0.002 * size[1]).with_d_over_r0(3.0)
    turbulence = Turbulence(path, views=1, height=size[0], width=size[1])
    seen = turbulence.degrade(torch.rand(1, 2, *size), seed())
    assert seen.shape[-2:] == size
    assert seen.isfinite().all()


def test_bf16_frames_are_simulated_in_float32():
    frames, turbulence = torch.rand(1, 1, 24, 24).bfloat16(), operator(2.0, size=24)
    seen = turbulence.degrade(frames, seed())
    assert seen.dtype == torch.float32
    assert torch.equal(seen, turbulence.degrade(frames.float(), seed()))


@pytest.mark.parametrize("airy", [0.3, 1.0, 1.7])
@pytest.mark.parametrize("kernel", [1, 7, 41])
def test_halo_is_the_light_beyond_the_kernel(airy, kernel):
    mean = mean_short_exposure_psf(3.0, unresolved_structure_function() * 3.0 ** (5 / 3))
    whole, halo = (PSFHalo(mean, airy, size) for size in (1, kernel))
    assert 0 <= halo.share <= 1 - whole.psf[whole.reach, whole.reach]
    spark = torch.zeros(1, 101, 101)
    spark[0, 50, 50] = 1
    light = shine(halo, spark, (0, 0, 101, 101))
    far = halo.reach
    torch.testing.assert_close(
        light[50 - far : 51 + far, 50 - far : 51 + far], halo.psf, atol=1e-6, rtol=0
    )
    part = shine(halo, spark, (40, 45, 9, 30))
    torch.testing.assert_close(part, light[40:49, 45:75], atol=1e-6, rtol=0)


@pytest.mark.slow
def test_a_large_frame_is_made_in_tiles_without_seams():
    path = replace(PATH, scene_width_m=3.0).with_d_over_r0(2.0)
    turbulence = Turbulence(path, views=1, height=2048, width=2048)
    frames = torch.rand(1, 1, 2048, 2048)
    seen = turbulence.degrade(frames, seed())
    part = turbulence.degrade(frames, seed(), crop=(300, 300, 40, 40))  # across the seam at 320
    torch.testing.assert_close(seen[..., 300:340, 300:340], part, atol=2e-5, rtol=0)


@pytest.mark.parametrize("ar1_coefficient", [0.0, 1.0])
def test_extremes_of_the_ar1_coefficient_over_a_thousand_frames(ar1_coefficient):
    path = replace(PATH.with_d_over_r0(3.0), ar1_coefficient=ar1_coefficient)
    turbulence = Turbulence(path, views=9, height=32, width=32)
    tilt = turbulence.tilt(1000, seed(), crop=(16, 16, 1, 1))[..., 0, 0]
    assert tilt.isfinite().all()
    if ar1_coefficient == 1.0:
        torch.testing.assert_close(tilt[:, 0], tilt[:, -1])
    else:
        spread = tilt.square().mean().sqrt()
        assert spread == pytest.approx(turbulence.fidelity.tilt_px, rel=0.05)


@pytest.mark.parametrize(
    "options, message",
    [
        ({"tolerance": -1.0}, r"turbulence\.tolerance must be in \(0, 1\], got -1"),
        ({"tolerance": math.nan}, r"turbulence\.tolerance"),
        ({"fps": 0.0}, r"turbulence\.fps must be > 0"),
        (
            {"temporal_model": "magic"},
            r"turbulence\.temporal_model must be ar1, frozen_flow or mixed",
        ),
        ({"views_correlation": "maybe"}, r"turbulence\.views_correlation"),
        ({"wind_m_s": -1.0}, r"turbulence\.wind_m_s"),
        ({"baseline_m": -1.0}, r"turbulence\.baseline_m"),
        ({"height": 0}, r"turbulence\.frame must be at least 1 x 1"),
        ({"views": 7}, r"optics\.views"),
    ],
)
def test_bad_options_are_refused_by_name(options, message):
    given = {"views": 1, "height": 8, "width": 8} | options
    with pytest.raises(ValueError, match=message):
        Turbulence(PATH, **given)


def test_turbulence_stronger_than_the_fitted_psfs_is_refused():
    with pytest.raises(ValueError, match=r"D/r0 of the blur must be <= 10\.6, got 30"):
        operator(30.0)


def test_frames_and_crops_that_do_not_fit_are_refused():
    turbulence = operator(2.0)
    with pytest.raises(ValueError, match=r"turbulence\.frame must be \(64, 64\)"):
        turbulence.degrade(torch.rand(1, 1, 32, 64), seed())
    with pytest.raises(ValueError, match=r"turbulence\.crop must be inside"):
        turbulence.degrade(torch.rand(1, 1, 64, 64), seed(), crop=(40, 0, 32, 32))
