"""A batch of clips of different sensors in one call is each clip by itself, bit for bit."""

import sys
from types import ModuleType

import numpy as np
import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from src.sim.sensor import EventSensor
from src.sim.sensor.engine_input import SensorClip
from src.sim.sensor.engines import run, sensor_cpu
from src.sim.sensor.engines.records import EngineInput
from src.sim.sensor.sensor import Sensor, simulate_voxels
from tests.sim.sensor.test_sensor import signals

VIEWS = [143, 7]
FPS = [120.0, 97.3, 240.0, 60.0]
KEYS = [5, 5, 11, 2**40]
ORIGINS = [(0, 0), (5, 7), (31, 2), (5, 7)]
FULL_WIDTHS = [99, 99, 40, 8]
DRAWN = (
    {"threshold": 0.1},
    {"threshold": 0.35, "off_ratio": 1.4, "refractory_s": 0.0, "mismatch": 0.2, "seed": 3},
    {
        "threshold": 0.2,
        "dark_noise_hz": 60.0,
        "leak_event_hz": 8.0,
        "initial_reference_error": 0.9,
        "seed": 2**50,
    },
    {
        "hot_pixel_fraction": 0.2,
        "hot_pixel_hz": 50.0,
        "mismatch": 0.1,
        "initial_reference_error": 0.3,
        "refractory_s": 0.02,
    },
)
LOW_PASS = (20.0, 50.0, 50.0, 200.0)


def sensors(low_pass: bool, **common) -> list[EventSensor]:
    """Four sensors that differ in all that may differ within one call."""
    cutoffs = LOW_PASS if low_pass else (0.0,) * 4
    return [
        EventSensor(**drawn, cutoff_hz=cutoff, **common)
        for drawn, cutoff in zip(DRAWN, cutoffs, strict=True)
    ]


def clips(frames: int = 7) -> torch.Tensor:
    """Frames (4, 2, frames, 6, 8)."""
    return torch.stack([signals(seed, frames) for seed in range(8)]).view(4, 2, frames, 6, 8)


def alone(many, frames: torch.Tensor, i: int, **settings) -> torch.Tensor:
    """The grids of clip `i` from its own sensor, (1, windows, views, bins, h, w)."""
    own = {"clips": [KEYS[i]], "views": VIEWS, "origin": ORIGINS[i], "full_width": FULL_WIDTHS[i]}
    return many[i].voxels(frames[i : i + 1], FPS[i], **own, **settings).transpose(1, 2)


def sensor_clips(many, which=range(4), fps=FPS) -> list[SensorClip]:
    """What goes with the frames of some of the clips, of which `many` are the sensors."""
    numbers = [(fps[i], KEYS[i], ORIGINS[i], FULL_WIDTHS[i]) for i in which]
    return [SensorClip(sensor, *own) for sensor, own in zip(many, numbers, strict=True)]


def simulate(many, frames: torch.Tensor, views=VIEWS, which=range(4), **options) -> torch.Tensor:
    return simulate_voxels(sensor_clips(many, which), frames, views, **options)


@pytest.mark.parametrize("low_pass", [False, True], ids=["", "low-pass"])
@pytest.mark.parametrize("stamps", ["linear", "v2e"])
@pytest.mark.parametrize("refractory", ["defer", "delete", "hold"])
def test_a_batch_is_its_clips_one_by_one(refractory, stamps, low_pass):
    many, frames = sensors(low_pass, refractory=refractory, stamps=stamps), clips()
    whole = simulate(many, frames, substeps=2)
    assert whole.shape == (4, 3, 2, 5, 6, 8) and whole.is_contiguous()
    for i in range(4):
        assert torch.equal(whole[i : i + 1], alone(many, frames, i, substeps=2)) and whole[i].any()


@pytest.mark.parametrize("stamps", ["linear", "v2e"])
def test_float16_is_read_as_if_it_had_been_widened(stamps):
    """Also light that float32 cannot tell from black, and what rounding puts below it."""
    many, narrow = sensors(True, stamps=stamps), clips().half()
    narrow[0, 0, :, 0, :3] = torch.tensor([-5e-5, 3e-6, 6e-5])
    assert torch.equal(simulate(many, narrow), simulate(many, narrow.float()))


def test_frames_may_lie_in_memory_in_any_order():
    many, frames = sensors(False), clips()
    turned = frames.permute(2, 4, 0, 3, 1).contiguous().permute(2, 4, 0, 3, 1)
    wider = torch.zeros(4, 2, 9, 8, 9)
    wider[:, :, 1:8, 1:7, 1:] = frames
    expected = simulate(many, frames)
    for strided in (turned, wider[:, :, 1:8, 1:7, 1:]):
        assert not strided.is_contiguous()
        assert torch.equal(simulate(many, strided), expected)


def test_law_3_a_clip_and_a_view_are_the_same_in_any_batch():
    many, frames = sensors(True), clips()
    whole = simulate(many, frames)
    order = [3, 1]
    part = simulate([many[i] for i in order], frames[order], which=order)
    assert torch.equal(part, whole[order])
    one = simulate(many, frames[:, 1:], VIEWS[1:])
    assert torch.equal(one, whole[:, :, 1:])


class Dimmer:
    """A sensor of another class: it keeps the contract and nothing more."""

    threshold, random = 0.3, {}

    def draw(self, key: int, seed: int | None = None) -> "Dimmer":
        return self

    def voxels(self, frames, fps, bins=5, *, substeps=1, clips=None, views=None, origin=(0, 0),
               full_width=None):  # fmt: skip
        n, v, count, h, w = frames.shape
        own = self.threshold + fps + clips[0] + sum(views) + sum(origin) + full_width
        windows = frames[:, :, substeps::substeps, None] * own
        return windows.expand(n, v, (count - 1) // substeps, bins, h, w)


class Derived(EventSensor):
    """One derived from ours, which makes twice the events."""

    def voxels(self, *args, **kwargs) -> torch.Tensor:
        return 2 * super().voxels(*args, **kwargs)


def test_sensors_of_another_kind_or_class_are_simulated_among_the_others():
    ours, frames = sensors(False), clips().half()
    holding = EventSensor(0.2, refractory="hold", dark_noise_hz=50.0)
    many = [ours[0], Dimmer(), holding, Derived(0.2)]
    assert isinstance(many[1], Sensor)
    whole = simulate(many, frames)
    for i in range(4):
        exact = alone(many, frames.float(), i)
        assert torch.equal(whole[i : i + 1], exact) and whole[i].any()


@pytest.mark.parametrize("same", [True, False])
def test_the_grids_are_put_where_they_are_wanted(same):
    many, frames = sensors(False), clips()
    many[0] = many[0] if same else Dimmer()
    larger = torch.zeros(6, 6, 2, 5, 6, 8)
    found = simulate(many, frames, out=larger[1:5])
    assert found.data_ptr() == larger[1].data_ptr() and not larger[[0, 5]].any()
    assert torch.equal(found, simulate(many, frames))


def test_kinds_are_told_apart_and_numbers_are_not(monkeypatch):
    """One call of an engine for sensors that differ in numbers, one more for each other kind."""
    ran: list[EngineInput] = []
    cpu = sensor_cpu.voxels
    monkeypatch.setattr(sensor_cpu, "voxels", lambda given, g: ran.append(given) or cpu(given, g))
    simulate(sensors(True), clips())
    assert [len(given.clips) for given in ran] == [4]
    ran.clear()
    many = sensors(False, refractory="hold")
    many[1] = sensors(False, refractory="delete")[1]
    many[2] = sensors(True, refractory="hold")[2]
    simulate(many, clips())
    assert sorted(len(given.clips) for given in ran) == [1, 1, 2]


def test_more_clips_are_not_more_operators():
    """On a GPU each operator is a launch."""
    counts = []
    for which in ([2], [0, 1, 2, 3]):
        many, frames = [sensors(True)[i] for i in which], clips()[which]
        with profile(activities=[ProfilerActivity.CPU]) as seen:
            simulate(many, frames, which=which)
        counts.append(sum(event.name.startswith("aten::") for event in seen.events()))
    assert 0 < counts[1] <= counts[0] < 60


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"many": 3}, "frames must be of 3 clips and 2 views, got"),
        ({"views": [1, 2, 3]}, "frames must be of 4 clips and 3 views, got"),
        ({"threshold": 9.0}, r"sensor.threshold must be in \[0.01, 5\], got 9"),
        ({"threshold": [0.1, 0.7]}, "sensor.threshold is the range 0.1 to 0.7: `draw` the sensor"),
        ({"fps": [120.0, 120.0, 120.0, 40.0]}, r"sensor.hot_pixel_hz must be in \[0, 40\], got 50"),
        ({"fps": [120.0, -1.0, 120.0, 120.0]}, "fps must be in"),
        ({"substeps": 7}, "at least 8 frames, got 7"),
        ({"out": torch.zeros(4, 5, 2, 5, 6, 8)}, r"out must be contiguous \(4, 6, 2, 5, 6"),
        ({"out": torch.zeros(4, 2, 6, 5, 6, 8).transpose(1, 2)}, "out must be contiguous"),
    ],
)
def test_what_does_not_fit_is_named(change, words):
    count, fps = change.pop("many", 4), change.pop("fps", FPS)
    many, views = sensors(False)[:count], change.pop("views", VIEWS)
    many[0].threshold = change.pop("threshold", 0.1)
    with pytest.raises(ValueError, match=words):
        simulate_voxels(sensor_clips(many, range(count), fps), clips(), views, **change)


@pytest.mark.parametrize("value", [-0.01, 1.01, np.nan, -np.inf])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
def test_one_wrong_pixel_of_one_clip_is_named(dtype, value):
    frames = clips().to(dtype)
    frames[2, 1, 4, 5, 7] = value
    with pytest.raises(ValueError, match=r"frames must be finite and in \[0, 1\], got"):
        simulate(sensors(False), frames)


def test_light_that_rounding_put_outside_is_taken():
    frames = clips()
    frames[1, 0, 2, :, :4] = torch.tensor([-0.0, -9e-5, 1.00009, 1.0])
    assert torch.isfinite(simulate(sensors(False), frames)).all()


def test_where_tritons_kernel_fails_the_cpu_goes_on_and_it_is_said(monkeypatch):
    class Failing(ModuleType):
        @staticmethod
        def voxels(given, grids):
            raise RuntimeError("Failed to find C compiler")

    sensor, frames = EventSensor(0.2), clips()
    expected = sensor.voxels(frames, 120.0)
    name = "sensor_triton"
    monkeypatch.setitem(sys.modules, f"src.sim.sensor.engines.{name}", Failing(name))
    monkeypatch.setattr(run, "uses_triton", lambda given: True)
    monkeypatch.setattr(run, "TRITON_FAILURES", [])
    with pytest.warns(UserWarning, match="Triton fails, the CPU simulates .* C compiler"):
        seen = sensor.voxels(frames, 120.0)
    assert torch.equal(seen, expected) and len(run.TRITON_FAILURES) == 1
