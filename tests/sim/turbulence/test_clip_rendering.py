"""A clip's views all at once, as on a device: the same pictures in few launches."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.turbulence import Work, kernels
from src.sim.turbulence import clip_rendering, sample_atmosphere
from src.sim.turbulence.clip_plan import ALIGNMENT, PackedTensors, _wave_tables
from src.sim.turbulence.coefficient_grid import (
    GridAxis,
    WaveSum,
    evaluate_waves,
    sum_waves,
    zero_weak_responses,
)
from src.sim.turbulence.engines import blur_torch, device
from src.sim.turbulence.engines.device import full_float32
from src.sim.turbulence.engines.scatter_numba import scatter_normalised
from src.sim.turbulence.engines.warp_numba import pad_frames, warp_frames
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.p2s import FittedPSFs, load_bands_by_d_over_r0
from src.sim.turbulence.plane_waves import draw_plane_waves
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.training.parallel_fill import PreparedTurbulence, prepare_turbulence
from tests.sim.turbulence.test_turbulence import PATH, operator, seed

CROP = (9, 17, 30, 40)


def render_on_device(frames: torch.Tensor, plans) -> torch.Tensor:
    """Return what a device without Triton renders."""
    return clip_rendering.render_views(frames[0], plans, use_cpu_engines=False)[None]


def both(turbulence: Turbulence, frames: torch.Tensor, crop=CROP) -> tuple[torch.Tensor, ...]:
    """Return the views as the CPU renders them, and as a device does."""
    plans = turbulence.plan(frames.shape[1], seed(), crop)
    return turbulence.degrade(frames, seed(), crop=crop), render_on_device(frames, plans)


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0, 10.6])
@pytest.mark.parametrize("temporal_model", ["ar1", "frozen_flow"])
def test_all_at_once_equals_view_by_view(strength, temporal_model):
    turbulence = operator(strength, views=9, temporal_model=temporal_model)
    one, other = both(turbulence, torch.rand(1, 3, 64, 64))
    torch.testing.assert_close(other, one, atol=5e-6, rtol=0)


@pytest.mark.parametrize("tolerance", [0.9, 0.02])
@pytest.mark.parametrize("shared", ["independent", "baseline"])
def test_any_fidelity_and_views_that_share_their_air(tolerance, shared):
    turbulence = operator(3.0, views=4, views_correlation=shared, tolerance=tolerance)
    one, other = both(turbulence, torch.rand(1, 2, 64, 64), (0, 0, 64, 64))
    torch.testing.assert_close(other, one, atol=5e-6, rtol=0)


def test_drawn_air_of_training():
    for number in range(6):
        path = sample_atmosphere("mixed", seed(number))
        turbulence = Turbulence(path, views=[(0, 0), (1, 1)], height=256, width=256)
        one, other = both(turbulence, torch.rand(1, 3, 256, 256), (90, 0, 48, 64))
        torch.testing.assert_close(other, one, atol=5e-6, rtol=0)


def test_parts_and_tiles_change_nothing(monkeypatch):
    turbulence, frames = operator(2.0, views=4), torch.rand(1, 5, 64, 64)
    _, other = both(turbulence, frames)
    monkeypatch.setattr(clip_rendering, "DEVICE_BYTES", 2_000_000)
    monkeypatch.setattr("src.sim.turbulence.operator.TILE", 16)
    plans = turbulence.plan(5, seed(), CROP)
    assert len(plans) == 6
    assert clip_rendering._numbers_per_picture(plans[0], blur_torch) * 4 * 20 > 2_000_000
    torch.testing.assert_close(render_on_device(frames, plans), other, atol=5e-6, rtol=0)
    tilt = turbulence.tilt(5, seed(), crop=CROP)
    monkeypatch.undo()
    torch.testing.assert_close(turbulence.tilt(5, seed(), crop=CROP), tilt, atol=1e-4, rtol=0)


def test_prepared_turbulence_is_small_can_be_sent_and_is_for_one_crop():
    turbulence = Turbulence(PATH.with_d_over_r0(2.0), views=9, height=256, width=256)
    ahead = prepare_turbulence(turbulence, 4, seed(), CROP)
    frames = torch.rand(1, 4, 256, 256)
    sent = pickle.dumps(ahead)
    assert len(sent) < 1_000_000
    again = pickle.loads(sent)
    ours, theirs = (one.degrade(frames, seed(), crop=CROP) for one in (again, ahead))
    assert torch.equal(ours, theirs)
    assert isinstance(again, PreparedTurbulence) and again.metadata == turbulence.metadata
    with pytest.raises(ValueError, match=r"is of 1 clip in \(9, 17, 30, 40\), got 2 in"):
        ahead.degrade(frames.expand(2, -1, -1, -1), seed(), crop=CROP)
    with pytest.raises(ValueError, match="got 1 in None"):
        ahead.degrade(frames, seed())


class Launches(Work):
    """Counts a device's operators and refuses those that wait for it."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1]
        assert name not in ("_local_scalar_dense", "nonzero", "item", "unique"), name
        return super().__torch_dispatch__(func, types, args, kwargs)


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
def test_a_clip_is_few_launches_none_of_which_is_waited_for(strength, monkeypatch):
    turbulence, frames = operator(strength, views=9), torch.rand(1, 5, 64, 64)
    plans = turbulence.plan(5, seed(), CROP)
    for engine, most in ((kernels(Work()), 55), (blur_torch, 95)):
        monkeypatch.setattr(device, "select_blur_engine", lambda device, engine=engine: engine)
        with Launches() as work:
            render_on_device(frames, plans)
        assert 30 < work.launches <= most


@pytest.mark.parametrize("pitch", [1, 5])
def test_torch_expressions_equal_the_compiled_ones(pitch):
    rows, columns = GridAxis(-3, 40, pitch, 1), GridAxis(2, 37, pitch, 1)
    frames, tilt = torch.rand(2, 30, 41), 3 * torch.randn(2, 6, 40, 37)
    psfs = FittedPSFs(load_bands_by_d_over_r0()[2], 0, 20, 1.3, 7)
    weights = 0.5 * torch.randn(20, 6, rows.node_count, columns.node_count)
    one = torch.ones_like(weights[:1])
    pixels = torch.einsum("rij,rnyx->ijnyx", psfs.basis, torch.cat([one, weights])).flatten(0, 1)
    halo = 0.2 * torch.rand(2, 34, 31)
    lines = pixels @ columns.interpolation_matrix().T
    ours = blur_torch.warp_cubic(frames, tilt, rows.start, columns.start)
    ours = blur_torch.scatter_normalised(ours, lines, rows, halo, 0.1)
    basis = psfs.quarter, np.array(psfs.parity_ends)
    padded = pad_frames(frames)
    for picture in range(6):
        view = tilt[:, picture : picture + 1].contiguous()
        [warped] = warp_frames(padded, picture % 2, view, rows.start, columns.start)
        offsets = rows.offset_from_first_node_px, columns.offset_from_first_node_px
        given = *basis, *offsets, pitch, halo[picture % 2].numpy()
        theirs = torch.from_numpy(scatter_normalised(warped, weights.numpy(), picture, *given, 0.1))
        torch.testing.assert_close(ours[picture], theirs, atol=5e-6, rtol=0)


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (60, 60)])
def test_far_outside_the_frame_lies_its_reflection(size):
    frames, tilt = torch.rand(1, *size), 30 * torch.randn(2, 1, 90, 80)
    [theirs] = warp_frames(pad_frames(frames), 0, tilt, -40, -30)
    ours = blur_torch.warp_cubic(frames, tilt, -40, -30)[0]
    torch.testing.assert_close(ours, torch.from_numpy(theirs), atol=2e-6, rtol=0)


@pytest.mark.parametrize("pitch", [1, 3])
@pytest.mark.parametrize("columns", [30, 31])
def test_both_sums_of_waves_equal_the_definition(pitch, columns):
    waves = draw_plane_waves(PATH.with_d_over_r0(3.0), 1, modes=14, waves=100, width_px=64)
    grid = GridAxis(-3, 20, pitch, 1), GridAxis(2, columns, pitch, 1)
    amplitudes = torch.randn(2, 100, dtype=torch.complex64)
    tables = _wave_tables("psf", grid, waves, (64, 64))
    response = zero_weak_responses(torch.view_as_complex(waves.response).to(torch.complex64)[2:], 2)
    turned = response * tables["psf_response"]
    along = tables["psf_rows"], tables["psf_columns"]
    found = sum_waves(turned, amplitudes, evaluate_waves(*along))
    y, x = (axis.node_pixels.double() - 31.5 for axis in grid)
    turns = (
        waves.frequency_per_px[:, 1, None, None] * y[:, None]
        + waves.frequency_per_px[:, 0, None, None] * x
    )
    wave = torch.exp(2j * torch.pi * turns).to(torch.complex64)
    expected = torch.einsum("mw,nw,wyx->mnyx", response, amplitudes, wave).real
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    found = WaveSum(turned, *along, 2)(amplitudes)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    assert found.std() > 0.01


def test_tensors_are_the_same_after_they_were_packed():
    tables = {
        "a": torch.rand(3, 5).T, "b": torch.rand(7, dtype=torch.complex64), "c": torch.zeros(0, 4),
        "d": torch.arange(5), "e": torch.rand(2, 3, dtype=torch.float64),
    }  # fmt: skip
    packed = PackedTensors(tables)
    found = pickle.loads(pickle.dumps(packed)).to(torch.device("cpu"))
    assert all(torch.equal(found[name], tables[name]) for name in tables)
    assert packed.packed[0].nbytes % ALIGNMENT == 0


def test_products_are_float32_whatever_was_allowed_and_stay_allowed():
    products = torch.backends.cuda.matmul
    for allowed in (True, False):
        products.allow_tf32 = allowed
        with full_float32():
            assert not products.allow_tf32
        assert products.allow_tf32 == allowed


def test_the_operator_of_the_same_atmosphere_is_cached():
    air, size = SimulatedTurbulence({"severity": "weak"}), {"height": 64, "width": 64, "fps": 120.0}
    path = air.draw(seed())
    one = air.operator(path, views=[(0, 0)], **size)
    assert air.operator(copy.copy(path), views=((0, 0),), **size) is one
    assert air.operator(replace(path, ar1_coefficient=0.5), views=[(0, 0)], **size) is not one
    rough = SimulatedTurbulence({"severity": "weak"}, tolerance=0.9)
    assert rough.operator(path, views=[(0, 0)], **size) is not one


@pytest.mark.gpu
@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
def test_cuda_gives_the_same_picture(strength):
    frames, turbulence = torch.rand(1, 3, 64, 64), operator(strength, views=4)
    ours = turbulence.degrade(frames, seed())
    theirs = turbulence.degrade(frames.cuda(), seed()).cpu()
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0)
    assert device.select_blur_engine(torch.device("cuda", 0)).__name__.endswith("blur_triton")
