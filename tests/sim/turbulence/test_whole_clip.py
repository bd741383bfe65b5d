"""A clip's views all at once, as on a device: the same pictures in few launches."""

import copy
import pickle
from collections import Counter
from dataclasses import replace
from types import ModuleType

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from src.sim.turbulence import blur, sample_atmosphere, whole_clip
from src.sim.turbulence.ahead import AirAhead
from src.sim.turbulence.engines import blur_eager, blur_engine
from src.sim.turbulence.engines.device import ALIGNED, Packed, full_float32
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.operator import Turbulence
from src.sim.turbulence.p2s import Spots, bands
from src.sim.turbulence.phase import draw_waves
from src.sim.turbulence.simulated import SimulatedAir
from src.sim.turbulence.wave_field import Field
from tests.sim.turbulence.test_turbulence import PATH, operator, seed

CROP = (9, 17, 30, 40)


def both(turbulence: Turbulence, frames: torch.Tensor, crop=CROP) -> tuple[torch.Tensor, ...]:
    """Return what the CPU's views see, and what all views see at once."""
    ahead = turbulence.ahead(frames.shape[1], seed(), crop)
    return turbulence.degrade(frames, seed(), crop=crop), ahead.degrade(frames, seed(), crop=crop)


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0, 30.0])
@pytest.mark.parametrize("options", [{"temporal": "ar1"}, {"temporal": "flow", "psf": "exact"}])
def test_all_at_once_equals_view_by_view(strength, options):
    one, other = both(operator(strength, views=9, **options), torch.rand(1, 3, 64, 64))
    torch.testing.assert_close(other, one, atol=5e-6, rtol=0)


@pytest.mark.parametrize(
    "options", [{"modes": 2}, {"modes": 3}, {"tolerance": 0.9}, {"tolerance": 0.02}]
)
@pytest.mark.parametrize("shared", ["independent", "baseline"])
def test_any_fidelity_and_views_that_share_their_air(options, shared):
    turbulence = operator(3.0, views=4, views_correlation=shared, **options)
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
    monkeypatch.setattr(whole_clip, "MEMORY", 2_000_000)
    monkeypatch.setattr("src.sim.turbulence.operator.TILE", 16)
    ahead = turbulence.ahead(5, seed(), CROP)
    assert len(ahead.plans) == 6
    assert len(list(whole_clip._parts(ahead.plans[0].amplitudes, ahead.plans[0]))) > 1
    torch.testing.assert_close(ahead.degrade(frames, seed(), crop=CROP), other, atol=5e-6, rtol=0)
    tilt = turbulence.tilt(5, seed(), crop=CROP)
    torch.testing.assert_close(ahead.tilt(5, seed(), crop=CROP), tilt, atol=1e-4, rtol=0)


def test_air_ahead_is_small_can_be_sent_and_is_for_one_crop():
    turbulence = Turbulence(PATH.at(2.0), views=9, height=256, width=256)
    ahead, frames = turbulence.ahead(4, seed(), CROP), torch.rand(1, 4, 256, 256)
    sent = pickle.dumps(ahead)
    assert len(sent) < 1_000_000
    again = pickle.loads(sent)
    assert torch.equal(
        again.degrade(frames, seed(), crop=CROP), ahead.degrade(frames, seed(), crop=CROP)
    )
    assert isinstance(again, AirAhead) and again.facts == turbulence.facts
    with pytest.raises(ValueError, match=r"air ahead is of 1 clip in \(9, 17, 30, 40\), got 2 in"):
        ahead.degrade(frames.expand(2, -1, -1, -1), seed(), crop=CROP)
    with pytest.raises(ValueError, match="got 1 in None"):
        ahead.degrade(frames, seed())
    clear = Turbulence(None, views=9, height=256, width=256)
    assert clear.ahead(4, seed(), CROP) is clear


class Launches(TorchDispatchMode):
    """Counts operators that are no views, a device's work, and refuses those that wait for it."""

    FREE = ("empty", "new_empty", "empty_strided", "_unsafe_view", "detach", "lift_fresh", "arange")

    def __init__(self):
        super().__init__()
        self.count = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.split("::")[1]
        assert name not in ("_local_scalar_dense", "nonzero", "item", "unique"), name
        if not func.is_view and name not in self.FREE:
            self.count[name] += 1
        return func(*args, **kwargs or {})


def kernels() -> ModuleType:
    """Return an engine of as many operators as Triton's has."""

    def warp(frames, tilt, *_):
        torch.aminmax(frames.flatten(1), dim=1)
        return tilt[0] + tilt[1]

    def scatter(image, psfs, rows, halo, *_):
        return image[:, : halo.shape[1], : halo.shape[2]] + 1

    engine = ModuleType("kernels")
    engine.WARP, engine.SCATTER, engine.warp, engine.scatter = 8, 0, warp, scatter
    return engine


@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
def test_a_clip_is_few_launches_none_of_which_is_waited_for(strength, monkeypatch):
    turbulence, frames = operator(strength, views=9), torch.rand(1, 5, 64, 64)
    ahead = turbulence.ahead(5, seed(), CROP)
    for engine, most in ((kernels(), 55), (blur_eager, 95)):
        monkeypatch.setattr(blur_engine, "on", lambda device, engine=engine: engine)
        with Launches() as launches:
            ahead.degrade(frames, seed(), crop=CROP)
        assert 30 < sum(launches.count.values()) <= most, launches.count


@pytest.mark.parametrize("pitch", [1, 5])
@pytest.mark.parametrize("fitted", [True, False])
def test_torch_expressions_equal_the_compiled_ones(pitch, fitted):
    rows, columns = Lattice(-3, 40, pitch, 1), Lattice(2, 37, pitch, 1)
    frames, tilt = torch.rand(2, 30, 41), 3 * torch.randn(2, 6, 40, 37)
    spots = Spots(bands()[2], 0, 20, 1.3, 7, 3.0)
    weights = 0.5 * torch.randn(20, 6, rows.nodes, columns.nodes)
    one = torch.ones_like(weights[:1])
    psfs = torch.einsum("rij,rnyx->ijnyx", spots.shapes, torch.cat([one, weights])).flatten(0, 1)
    nodes = weights if fitted else psfs.clamp(min=0)
    halo = 0.2 * torch.rand(2, 34, 31)
    lines = (psfs if fitted else nodes) @ columns.weights().T
    ours = blur.at_once(frames, tilt, lines, rows, columns, halo, 0.1)
    shown, around = blur.pictures(frames), (7, spots if fitted else None, rows, columns, halo, 0.1)
    for first in (0, 2, 4):  # the pictures of a view
        view = slice(first, first + 2)
        seen = (tilt[:, view].contiguous(), nodes[:, view].contiguous())
        theirs = blur.degrade(shown, 0, *seen, *around)
        torch.testing.assert_close(ours[view], theirs, atol=5e-6, rtol=0)
    part = blur.at_once(frames, tilt[:, 3:], lines[:, 3:], rows, columns, halo, 0.1, first=3)
    torch.testing.assert_close(part, ours[3:], atol=1e-6, rtol=0)


@pytest.mark.parametrize("size", [(1, 1), (3, 50), (60, 60)])
def test_far_outside_the_frame_lies_its_reflection(size):
    frames, rows, columns = torch.rand(1, *size), Lattice(-40, 90, 1, 1), Lattice(-30, 80, 1, 1)
    tilt = 30 * torch.randn(2, 1, 90, 80)
    tilted = blur_eager.warp(frames, tilt, -40, -30)
    around = (1, None, rows, columns, torch.zeros(1, 90, 80), 0.0)
    theirs = blur.degrade(blur.pictures(frames), 0, tilt, torch.ones(1, 1, 90, 80), *around)
    torch.testing.assert_close(tilted, theirs, atol=2e-6, rtol=0)


@pytest.mark.parametrize("pitch", [1, 3])
@pytest.mark.parametrize("columns", [30, 31])
def test_waves_are_summed_alike(pitch, columns):
    path = PATH.at(3.0)
    waves = draw_waves(path, 1, modes=14, waves=100, width_px=64)
    lattices = Lattice(-3, 20, pitch, 1), Lattice(2, columns, pitch, 1)
    amplitudes = torch.randn(2, 100, dtype=torch.complex64)
    ours = Field(waves, slice(2, None), *lattices, (64, 64)).at_nodes(amplitudes)
    turns = [
        torch.exp(-2j * torch.pi * waves.frequency[:, 1 - k, None] * (side.pixels - 31.5))
        for k, side in enumerate(lattices)
    ]
    at = whole_clip.waves_at(*(turn.to(torch.complex64) for turn in turns))
    heard = whole_clip._heard(torch.view_as_complex(waves.response[2:]).to(torch.complex64), 2)
    found = whole_clip.coefficients(heard, amplitudes, at)
    torch.testing.assert_close(found, ours, atol=1e-5, rtol=1e-5)
    assert ours.std() > 0.01


def test_tensors_are_the_same_after_they_were_packed():
    tables = {
        "a": torch.rand(3, 5).T, "b": torch.rand(7, dtype=torch.complex64), "c": torch.zeros(0, 4),
        "d": torch.arange(5), "e": torch.rand(2, 3, dtype=torch.float64),
    }  # fmt: skip
    packed = Packed(tables)
    found = pickle.loads(pickle.dumps(packed)).on(torch.device("cpu"))
    assert all(torch.equal(found[name], tables[name]) for name in tables)
    assert packed.memory.nbytes % ALIGNED == 0


def test_products_are_float32_whatever_was_allowed_and_stay_allowed():
    products = torch.backends.cuda.matmul
    for allowed in (True, False):
        products.allow_tf32 = allowed
        with full_float32():
            assert not products.allow_tf32
        assert products.allow_tf32 == allowed


def test_the_same_air_asked_for_again_is_remembered():
    air, size = SimulatedAir({"severity": "weak"}), {"height": 64, "width": 64, "fps": 120.0}
    path = air.draw(seed())
    one = air.operator(path, views=[(0, 0)], **size)
    assert air.operator(copy.copy(path), views=((0, 0),), **size) is one
    assert air.operator(replace(path, alpha=0.5), views=[(0, 0)], **size) is not one
    assert air.having(tolerance=0.9).operator(path, views=[(0, 0)], **size) is not one


@pytest.mark.gpu
@pytest.mark.parametrize("strength", [0.5, 2.0, 6.0])
def test_cuda_gives_the_same_picture(strength):
    frames, turbulence = torch.rand(1, 3, 64, 64), operator(strength, views=4)
    ours = turbulence.degrade(frames, seed())
    theirs = turbulence.degrade(frames.cuda(), seed()).cpu()
    torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=0)
    assert blur_engine.on(torch.device("cuda", 0)).__name__.endswith("blur_triton")
