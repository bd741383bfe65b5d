"""A batch of clips of different sensors in one call is each clip by itself, bit for bit."""

import numpy as np
import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from src.sim.sensor import EventSensor, batch
from src.sim.sensor.contract import Sensor
from src.sim.sensor.engines import run, sensor_cpu, sensor_eager
from src.sim.sensor.engines.job import Job
from src.sim.sensor.jobs import make_job
from tests.sim.sensor.test_sensor import signals

VIEWS = [143, 7]
FPS = [120.0, 97.3, 240.0, 60.0]
KEYS = {
    "fps": FPS,
    "clips": [5, 5, 11, 2**40],
    "origins": [(0, 0), (5, 7), (31, 2), (5, 7)],
    "full_widths": [99, 99, 40, 8],
}
DRAWN = (
    {"threshold": 0.1},
    {"threshold": 0.35, "off_ratio": 1.4, "refractory_s": 0.0, "mismatch": 0.2, "seed": 3},
    {"threshold": 0.2, "shot_hz": 60.0, "leak_hz": 8.0, "residual": 0.9, "seed": 2**50},
    {"hot_fraction": 0.2, "hot_hz": 50.0, "mismatch": 0.1, "residual": 0.3, "refractory_s": 0.02},
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
    own = {"clips": [KEYS["clips"][i]], "views": VIEWS, "origin": KEYS["origins"][i]}
    own |= {"full_width": KEYS["full_widths"][i], **settings}
    return many[i].voxels(frames[i : i + 1], FPS[i], **own).transpose(1, 2)


def some(which: list[int]) -> dict:
    """KEYS of some of the clips."""
    return {name: [values[i] for i in which] for name, values in KEYS.items()}


@pytest.mark.parametrize("low_pass", [False, True], ids=["", "low-pass"])
@pytest.mark.parametrize("stamps", ["linear", "v2e"])
@pytest.mark.parametrize("refractory", ["defer", "delete", "hold"])
def test_a_batch_is_its_clips_one_by_one(refractory, stamps, low_pass):
    many, frames = sensors(low_pass, refractory=refractory, stamps=stamps), clips()
    whole = batch.voxels(many, frames, substeps=2, views=VIEWS, **KEYS)
    assert whole.shape == (4, 3, 2, 5, 6, 8) and whole.is_contiguous()
    for i in range(4):
        assert torch.equal(whole[i : i + 1], alone(many, frames, i, substeps=2)) and whole[i].any()


@pytest.mark.parametrize("low_pass", [False, True], ids=["", "low-pass"])
@pytest.mark.parametrize("stamps", ["linear", "v2e"])
@pytest.mark.parametrize("refractory", ["defer", "delete", "hold"])
def test_engines_agree_on_a_batch_and_on_what_its_pixels_remember(refractory, stamps, low_pass):
    many, frames = sensors(low_pass, refractory=refractory, stamps=stamps), clips()
    found = [
        in_two_chunks(engine, many, part)
        for engine, part in ((sensor_cpu, frames), (sensor_eager, frames))
    ]
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def in_two_chunks(engine, many: list[EventSensor], frames: torch.Tensor) -> list[torch.Tensor]:
    """Grids, of two intervals each, and the pixels' memory."""
    grids, state = [], None
    for part in frames.split([3, frames.shape[2] - 3], 2):
        job = make_job(many, part, state=state, substeps=2, views=VIEWS, **KEYS)
        shape = (len(many), job.intervals // 2, len(VIEWS), 5, *frames.shape[-2:])
        grids.append(engine.voxels(job, torch.zeros(shape)))
        state = job.state
        state.frame += job.intervals
    return [*grids, state.level, state.source, state.reference, state.dead]


@pytest.mark.parametrize("engine", [sensor_cpu, sensor_eager])
def test_float16_is_read_as_if_it_had_been_widened(engine):
    """Also light that float32 cannot tell from black, and what rounding puts below it."""
    many, narrow = sensors(True), clips().half()
    narrow[0, 0, :, 0, :3] = torch.tensor([-5e-5, 3e-6, 6e-5])
    ours, theirs = (in_two_chunks(engine, many, part) for part in (narrow, narrow.float()))
    assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))


def test_frames_may_lie_in_memory_in_any_order():
    many, frames = sensors(False), clips()
    turned = frames.permute(2, 4, 0, 3, 1).contiguous().permute(2, 4, 0, 3, 1)
    wider = torch.zeros(4, 2, 9, 8, 9)
    wider[:, :, 1:8, 1:7, 1:] = frames
    expected = batch.voxels(many, frames, views=VIEWS, **KEYS)
    for strided in (turned, wider[:, :, 1:8, 1:7, 1:]):
        assert not strided.is_contiguous()
        assert torch.equal(batch.voxels(many, strided, views=VIEWS, **KEYS), expected)


def test_law_3_a_clip_and_a_view_are_the_same_in_any_batch():
    many, frames = sensors(True), clips()
    whole = batch.voxels(many, frames, views=VIEWS, **KEYS)
    order = [3, 1]
    part = batch.voxels([many[i] for i in order], frames[order], views=VIEWS, **some(order))
    assert torch.equal(part, whole[order])
    one = batch.voxels(many, frames[:, 1:], views=VIEWS[1:], **KEYS)
    assert torch.equal(one, whole[:, :, 1:])


class Dimmer:
    """A sensor of another class: it keeps the contract and nothing more."""

    threshold, drawn = 0.3, {}

    def draw(self, key: int, seed: int | None = None) -> "Dimmer":
        return self

    def voxels(self, frames, fps, bins=5, *, substeps=1, clips=None, views=None, origin=(0, 0),
               full_width=None, threshold=None):  # fmt: skip
        n, v, count, h, w = frames.shape
        own = float(threshold) + fps + clips[0] + sum(views) + sum(origin) + full_width
        windows = frames[:, :, substeps::substeps, None] * own
        return windows.expand(n, v, (count - 1) // substeps, bins, h, w)


class Derived(EventSensor):
    """One derived from ours, which makes twice the events."""

    def voxels(self, *args, **kwargs) -> torch.Tensor:
        return 2 * super().voxels(*args, **kwargs)


def test_sensors_of_another_kind_or_class_are_simulated_among_the_others():
    ours, frames = sensors(False), clips().half()
    many = [ours[0], Dimmer(), EventSensor(0.2, refractory="hold", shot_hz=50.0), Derived(0.2)]
    assert isinstance(many[1], Sensor)
    thresholds = [0.15, 0.25, 0.3, 0.35]
    whole = batch.voxels(many, frames, views=VIEWS, thresholds=thresholds, **KEYS)
    for i, threshold in enumerate(thresholds):
        exact = alone(many, frames.float(), i, threshold=torch.tensor([threshold]).double())
        assert torch.equal(whole[i : i + 1], exact) and whole[i].any()


@pytest.mark.parametrize("same", [True, False])
def test_the_grids_are_put_where_they_are_wanted(same):
    many, frames = sensors(False), clips()
    many[0] = many[0] if same else Dimmer()
    threshold = {"thresholds": [0.2] * 4}
    room = torch.zeros(6, 6, 2, 5, 6, 8)
    found = batch.voxels(many, frames, views=VIEWS, out=room[1:5], **threshold, **KEYS)
    assert found.data_ptr() == room[1].data_ptr() and not room[[0, 5]].any()
    assert torch.equal(found, batch.voxels(many, frames, views=VIEWS, **threshold, **KEYS))


def test_kinds_are_told_apart_and_numbers_are_not(monkeypatch):
    """One call of an engine for sensors that differ in numbers, one more for each other kind."""
    ran: list[Job] = []
    engine = run.engine
    monkeypatch.setattr(run, "engine", lambda job: ran.append(job) or engine(job))
    batch.voxels(sensors(True), clips(), views=VIEWS, **KEYS)
    assert [len(job.clips) for job in ran] == [4]
    ran.clear()
    many = sensors(False, refractory="hold")
    many[1] = sensors(False, refractory="delete")[1]
    many[2] = sensors(True, refractory="hold")[2]
    batch.voxels(many, clips(), views=VIEWS, **KEYS)
    assert sorted(len(job.clips) for job in ran) == [1, 1, 2]


def test_more_clips_are_not_more_operators():
    """On a GPU each operator is a launch."""
    counts = []
    for which in ([2], [0, 1, 2, 3]):
        many, frames = [sensors(True)[i] for i in which], clips()[which]
        with profile(activities=[ProfilerActivity.CPU]) as seen:
            batch.voxels(many, frames, views=VIEWS, thresholds=[0.2] * len(which), **some(which))
        counts.append(sum(event.name.startswith("aten::") for event in seen.events()))
    assert 0 < counts[1] <= counts[0] < 60


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fps": FPS[:3]}, "4 clips and 2 views need 4 fps, got 3"),
        ({"views": [1, 2, 3]}, "need 2 views, got 3"),
        ({"origins": [(0, 0)]}, "need 4 origins, got 1"),
        ({"thresholds": [0.2, 0.2, 9.0, 0.2]}, r"sensor.threshold must be in \[0.01, 5\], got 9"),
        ({"fps": [120.0, 120.0, 120.0, 40.0]}, r"sensor.hot_hz must be in \[0, 40\], got 50"),
        ({"fps": [120.0, -1.0, 120.0, 120.0]}, "fps must be in"),
        ({"substeps": 7}, "at least 8 frames, got 7"),
        ({"out": torch.zeros(4, 5, 2, 5, 6, 8)}, r"out must be contiguous float32 \(4, 6, 2, 5, 6"),
        ({"out": torch.zeros(4, 2, 6, 5, 6, 8).transpose(1, 2)}, "contiguous: False"),
    ],
)
def test_what_does_not_fit_is_named(change, words):
    with pytest.raises(ValueError, match=words):
        batch.voxels(sensors(False), clips(), **{"views": VIEWS} | KEYS | change)


@pytest.mark.parametrize("value", [-0.01, 1.01, np.nan, -np.inf])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("engine", [sensor_cpu, sensor_eager])
def test_one_wrong_pixel_of_one_clip_is_named(engine, dtype, value, monkeypatch):
    monkeypatch.setattr(run, "engine", lambda job: engine)
    frames = clips().to(dtype)
    frames[2, 1, 4, 5, 7] = value
    with pytest.raises(ValueError, match=r"frames must be finite and in \[0, 1\], got"):
        batch.voxels(sensors(False), frames, views=VIEWS, **KEYS)


def test_light_that_rounding_put_outside_is_taken():
    frames = clips()
    frames[1, 0, 2, :, :4] = torch.tensor([-0.0, -9e-5, 1.00009, 1.0])
    assert torch.isfinite(batch.voxels(sensors(False), frames, views=VIEWS, **KEYS)).all()


def test_where_tritons_kernel_fails_plain_torch_goes_on_and_it_is_said(monkeypatch):
    class Failing:
        @staticmethod
        def voxels(job, grids):
            raise RuntimeError("Failed to find C compiler")

    sensor, frames = EventSensor(0.2), signals(0, 5)[None]
    frames = frames if frames.ndim == 5 else frames[None]
    expected = sensor.voxels(frames, 120.0)
    monkeypatch.setattr(run, "engine", lambda job: Failing)
    monkeypatch.setattr(run, "WITHOUT_TRITON", [])
    with pytest.warns(UserWarning, match="Triton fails, plain PyTorch .* C compiler"):
        seen = sensor.voxels(frames, 120.0)
    assert torch.equal(seen, expected) and len(run.WITHOUT_TRITON) == 1
