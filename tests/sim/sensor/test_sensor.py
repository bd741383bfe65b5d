"""The sensor against its slow definition, its laws, and the errors it names."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from src.sim.sensor import response
from src.sim.sensor.engine_input import threshold_range
from src.sim.sensor.engines import sensor_cpu, sensor_numba
from src.sim.sensor.engines.records import NORMALS
from src.sim.sensor.sensor import EventSensor
from tests.sim.sensor import sensor_oracle

FPS = 120.0
EDGES = [math.ceil(k * 1e6 / FPS - 1e-6) for k in range(64)]
NOISY = dict(
    mismatch=0.1, leak_event_hz=5.0, dark_noise_hz=60.0, hot_pixel_fraction=0.1,
    hot_pixel_hz=100.0, cutoff_hz=50.0, response="linlog", off_ratio=1.3, seed=3,
)  # fmt: skip


def signals(seed: int = 0, frames: int = 9) -> torch.Tensor:
    """Frames (frames, 6, 8): walks, ramps, steps, 8-bit walks that return, reversals, rest."""
    g = torch.Generator().manual_seed(seed)
    rows = torch.empty(frames, 6, 8)
    k = torch.arange(frames)[:, None] / (frames - 1)
    walks = -1.5 + 0.4 * torch.randn(frames, 8, generator=g).cumsum(0)
    rows[:, 0] = torch.exp(walks).clamp(0.02, 1)
    rows[:, 1] = torch.exp(-3 + 3 * k * torch.rand(8, generator=g))
    rows[:, 2] = torch.where(k < torch.rand(8, generator=g), 0.05, 0.9)
    rows[:, 3] = torch.randint(0, 6, (frames, 8), generator=g) * 40 / 255
    rows[:, 4] = torch.where(torch.arange(frames)[:, None] % 2 == 0, 0.2, 0.2 + 0.7 * k)
    rows[:, 5] = 0.5
    return rows.clamp(0, 1)


def levels_of(sensor: EventSensor, frames: torch.Tensor) -> list[list[int]]:
    """The level sequence of every pixel, row by row."""
    table = response.response_table(sensor.response, sensor.input, sensor.floor)
    return read_levels(table, frames).flatten(1).T.tolist()


def read_levels(table: torch.Tensor, intensity: torch.Tensor) -> torch.Tensor:
    """The levels of intensities, int32, as the CPU kernel reads them."""
    flat = np.ascontiguousarray(intensity.numpy()).ravel()
    levels = np.empty(flat.size, np.int32)
    sensor_numba.read_levels(table.numpy(), flat, levels)
    return torch.from_numpy(levels).view(intensity.shape)


def expected(sensor: EventSensor, frames: torch.Tensor) -> list[list[tuple[int, int]]]:
    clip = sensor._engine_input(frames[None, None], FPS).clips[0]
    on, off = int(clip["on"]), int(clip["off"])
    wait = sensor_oracle.Fraction(float(np.float32(sensor.refractory_s * FPS)))
    pixels = levels_of(sensor, frames)
    if sensor.stamps == "v2e":
        lists = sensor_oracle.v2e(pixels, on, off, wait, sensor.refractory)
    else:
        lists = [sensor_oracle.linear(p, on, off, wait, sensor.refractory)[0] for p in pixels]
    return [sensor_oracle.ticks(events, EDGES) for events in lists]


def listed(events: np.ndarray, height: int, width: int) -> list[list[tuple[int, int]]]:
    """The events of every pixel, row by row."""
    out = [[] for _ in range(height * width)]
    for t, x, y, p in events.tolist():
        out[y * width + x].append((t, p))
    return out


def same(ours, theirs) -> bool:
    """Equal polarities in equal order, times within the one tick that a float32 may round."""
    return all(
        [p for _, p in a] == [p for _, p in b]
        and all(abs(s - t) <= 1 for (s, _), (t, _) in zip(a, b, strict=True))
        for a, b in zip(ours, theirs, strict=True)
    )


@pytest.mark.parametrize("stamps", ["linear", "v2e"])
@pytest.mark.parametrize("refractory", ["defer", "delete", "hold"])
@pytest.mark.parametrize("refractory_s", [0.0, 0.00051, 0.005, 0.02])
def test_events_are_the_definitions(stamps, refractory, refractory_s):
    for threshold in (0.1, 0.35):
        modes = {"stamps": stamps, "refractory": refractory}
        sensor, frames = EventSensor(threshold, refractory_s=refractory_s, **modes), signals()
        assert same(listed(sensor.events(frames, FPS), 6, 8), expected(sensor, frames))


@pytest.mark.parametrize("stamps", ["linear", "v2e"])
def test_a_tie_of_the_level_with_the_threshold_is_an_event(stamps):
    frames = torch.tensor([100, 200, 100, 200, 200, 100.0])[:, None, None] / 255
    sensor = EventSensor(0.5, stamps=stamps, refractory_s=0.0)
    ends = levels_of(sensor, frames)[0][:2]
    sensor.threshold = (ends[1] - ends[0] + 2.5) / 2**20  # after the sensor's own allowance
    events = sensor.events(frames, FPS)
    assert events["p"].tolist() == [1, -1, 1, -1]
    assert events["t"].tolist() == [EDGES[k] - 1 for k in (1, 2, 3, 5)]


@settings(max_examples=25, deadline=None)
@given(
    codes=st.lists(st.integers(0, 255), min_size=2, max_size=12),
    threshold=st.floats(0.05, 0.8),
    refractory=st.sampled_from(["defer", "delete", "hold"]),
    wait=st.sampled_from([0.0, 0.001, 0.005, 0.03]),
)
def test_any_8_bit_signal_gives_the_definitions_events(codes, threshold, refractory, wait):
    sensor = EventSensor(threshold, refractory=refractory, refractory_s=wait)
    frames = torch.tensor(codes, dtype=torch.float32)[:, None, None] / 255
    assert same(listed(sensor.events(frames, FPS), 1, 1), expected(sensor, frames))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("settings_", [{}, NOISY], ids=["clean", "noisy"])
@pytest.mark.parametrize("stamps", ["linear", "v2e"])
@pytest.mark.parametrize("refractory", ["defer", "delete", "hold"])
def test_the_gpu_agrees_bit_for_bit(settings_, stamps, refractory):
    frames = torch.rand(2, 3, 8, 63, 65, generator=torch.Generator().manual_seed(4))
    sensor = EventSensor(0.2, stamps=stamps, refractory=refractory, **settings_)
    place = {"origin": (5, 7), "full_width": 99}
    on_cpu = sensor.voxels(frames, FPS, **place)
    assert torch.equal(sensor.voxels(frames.cuda(), FPS, **place).cpu(), on_cpu)


@pytest.mark.parametrize("response_", ["log", "linlog"])
def test_an_ideal_sensor_keeps_the_change_of_log_intensity(response_):
    """Law 1: without dead time and noise, |C sum p - change| < C everywhere, at any frame."""
    frames = torch.rand(6, 16, 16, generator=torch.Generator().manual_seed(1)) * 0.9 + 0.09
    threshold = 0.17
    sensor = EventSensor(threshold, refractory_s=0.0, response=response_)
    total = sensor.voxels(frames[None, None], FPS)[0, 0].sum(1).cumsum(0).double()
    change = frames[1:].double().log() - frames[0].double().log()
    assert (total * threshold - change).abs().max() < threshold


def test_a_flat_scene_makes_no_event():
    """Law 7."""
    assert len(EventSensor(0.01).events(torch.full((5, 4, 4), 0.3), FPS)) == 0


@pytest.mark.parametrize("settings_", [{}, NOISY], ids=["clean", "noisy"])
def test_a_crop_and_another_batch_draw_the_same(settings_):
    """Laws 3 and 5: neither crop, batch, order of views nor number of threads changes a pixel."""
    frames = torch.rand(2, 3, 4, 20, 24, generator=torch.Generator().manual_seed(2))
    sensor = EventSensor(0.3, **settings_)
    whole = sensor.voxels(frames, FPS, clips=[7, 9], views=[143, 144, 145])
    part = sensor.voxels(
        frames[1:, [2, 0], :, 3:11, 5:17].contiguous(), FPS, clips=[9], views=[145, 143],
        origin=(3, 5), full_width=24,
    )  # fmt: skip
    assert torch.equal(part, whole[1:, [2, 0], :, :, 3:11, 5:17])
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        assert torch.equal(sensor.voxels(frames, FPS, clips=[7, 9], views=[143, 144, 145]), whole)
    finally:
        torch.set_num_threads(threads)


@pytest.mark.parametrize("settings_", [{}, NOISY], ids=["clean", "noisy"])
def test_how_many_pixels_are_simulated_together_changes_nothing(settings_, monkeypatch):
    """Neither units that cross rows nor a batch of events that is full before its unit is done."""
    frames = signals()[None, None]
    sensor = EventSensor(0.02, refractory_s=0.0, **settings_)
    place = {"origin": (3, 5), "full_width": 24}
    grids = sensor.voxels(frames, FPS, **place)
    counts, events = sensor.counts(frames, FPS), sensor.events(frames[0, 0], FPS, **place)
    monkeypatch.setattr(sensor_cpu, "UNIT", 5)
    assert torch.equal(sensor.voxels(frames, FPS, **place), grids)
    assert torch.equal(sensor.counts(frames, FPS), counts)
    assert np.array_equal(sensor.events(frames[0, 0], FPS, **place), events)


def test_the_pixels_are_the_same_over_clips_and_the_noise_is_not():
    frames = torch.full((2, 1, 30, 24, 24), 0.2)
    noise = EventSensor(0.3, dark_noise_hz=30.0).voxels(frames, FPS)
    assert not torch.equal(noise[0], noise[1])
    flicker = frames.clone()
    flicker[:, :, 1::2] = 0.3
    uneven = EventSensor(0.3, mismatch=0.2, refractory_s=0.0).voxels(flicker, FPS)
    assert torch.equal(uneven[0], uneven[1])
    assert uneven[0].abs().sum((0, 1, 2)).std() > 0


def test_a_sum_of_substeps_is_one_window():
    frames = signals(frames=9)[None, None]
    sensor = EventSensor(0.15)
    fine = sensor.voxels(frames, 960.0)
    coarse = sensor.voxels(frames, 960.0, substeps=4)
    assert coarse.shape == (1, 1, 2, 5, 6, 8)
    assert torch.equal(coarse.sum(3), fine.view(1, 1, 2, 4, 5, 6, 8).sum((3, 4)))


def test_a_ramp_cut_into_substeps_keeps_its_events():
    """Log intensity linear in time: samples in between change nothing but rounding."""
    coarse = torch.exp(torch.tensor([-2.0, -0.5, -1.7, -0.1]))
    fine = torch.exp(torch.tensor(np.interp(np.arange(25) / 8, np.arange(4), coarse.log())))
    sensor = EventSensor(0.1, refractory_s=0.0007)
    few = sensor.events(coarse[:, None, None], FPS)
    many = sensor.events(fine.float()[:, None, None], FPS * 8)
    assert few["p"].tolist() == many["p"].tolist()
    assert np.abs(few["t"] - many["t"]).max() <= 2


def test_the_low_pass_is_exact_at_any_frame_interval():
    """One pole whose input is linear in time: more samples of the same line, the same output."""
    table = response.response_table("log", "linear", 1 / 255)

    def filtered(samples: int) -> tuple[int, int]:
        """The last level after and before a low-pass of 20 Hz, seen `samples` times a frame."""
        decay, lag = response.low_pass_table(20.0, FPS * samples, "linear")
        line = torch.linspace(0.499, 0.5001, samples + 1)
        first, *levels = read_levels(table, line).numpy()
        old_level, old_source = (np.array([first], np.int32) for _ in range(2))
        for level, light in zip(levels, line.numpy()[1:], strict=True):
            new = np.array([level], np.int32)
            light = np.array([light])
            sensor_numba.apply_low_pass(decay, lag, light, old_level, old_source, new)
            old_level[:] = new
        return int(new[0]), int(new[0] - first)

    (once, moved), (often, _) = filtered(1), filtered(8)
    assert abs(once - often) <= 16
    whole = int(np.diff(read_levels(table, torch.tensor([0.499, 0.5001])).numpy())[0])
    assert 0.2 < moved / whole < 0.8


def test_the_noise_has_the_rates_it_is_given():
    frames = torch.zeros(1, 1, 121, 64, 64)
    counts = EventSensor(0.3, dark_noise_hz=5.0, refractory_s=0.0).counts(frames, FPS).sum()
    expected_events = 5.0 * 64 * 64
    assert abs(counts - expected_events) < 4 * math.sqrt(expected_events)
    white = EventSensor(0.3, dark_noise_hz=5.0, refractory_s=0.0).counts(frames + 1, FPS).sum()
    assert abs(white - expected_events / 4) < 4 * math.sqrt(expected_events / 4)
    leak = EventSensor(0.3, leak_event_hz=3.5, refractory_s=0.0).counts(frames, FPS)[0, 0]
    assert abs(leak[0] - 3.5 * 64 * 64) < 4 * math.sqrt(64 * 64 / 4) and leak[1] == 0
    hot = EventSensor(0.3, hot_pixel_fraction=0.01, hot_pixel_hz=60.0, refractory_s=0.0)
    share = hot.counts(frames, FPS).sum() / (60 * 64 * 64)
    assert abs(share - 0.01) < 4 * math.sqrt(0.01 / 64**2)


def test_leak_events_come_at_their_rate_from_the_start_and_not_all_at_once():
    seconds, hz, pixels = 0.5, 0.4, 128 * 128
    frames = torch.full((int(seconds * FPS) + 1, 128, 128), 0.4)
    sensor = EventSensor(0.3, leak_event_hz=hz, refractory_s=0.0, mismatch=0.1)
    counts = [np.histogram(sensor.events(frames, FPS)["t"], 5, (0, 1e6 * seconds))[0]]
    expected = hz * seconds * pixels / 5
    assert np.abs(counts[0] - expected).max() < 4 * math.sqrt(expected)
    after_any_light = replace(sensor, initial_reference_error=1.0)  # half have more than one way
    counts.append(np.histogram(after_any_light.events(frames, FPS)["t"], 5)[0])
    assert abs(counts[1].sum() - 2.5 * expected) < 4 * math.sqrt(2.5 * expected)


def test_noise_beyond_one_event_an_interval_is_refused():
    frames = torch.zeros(1, 1, 2, 4, 4)
    for name in ("leak_event_hz", "dark_noise_hz"):
        assert EventSensor(0.2, refractory_s=0.0, **{name: 1.0}).counts(frames, 1.0).sum() >= 0
        with pytest.raises(ValueError, match=rf"sensor.{name} must be in \[0, 1\]"):
            EventSensor(0.2, refractory_s=0.0, **{name: 1000.0}).counts(frames, 1.0)


def test_noise_comes_at_any_time_of_the_interval():
    sensor = EventSensor(0.3, dark_noise_hz=100.0, refractory_s=0.0)
    events = sensor.events(torch.zeros(2, 64, 64), FPS)
    share = np.histogram(events["t"], 5, (0, EDGES[1]))[0] / len(events)
    assert np.abs(share - 0.2).max() < 4 * math.sqrt(0.16 / len(events))


def test_mismatch_has_its_deviation_and_its_floor():
    drawn = np.random.default_rng(0).integers(0, 2**32, 40_000, np.uint32)

    def thresholds(mismatch: float) -> np.ndarray:
        out = np.empty(drawn.size, np.int32)
        whole = round(0.2 * response.UNIT), round(mismatch * response.UNIT)
        sensor_numba.spread_thresholds(*whole, NORMALS, drawn, out)
        return out / response.UNIT

    on = thresholds(0.15)
    assert abs(on.mean() - 0.2) < 4 * 0.03 / 200
    assert abs(on.std() / 0.03 - 1) < 4 / math.sqrt(2 * 200**2)
    assert thresholds(0.9).min() >= 0.049


@pytest.mark.parametrize("refractory_s", [0.0005, 0.005])
def test_v2es_single_pixel_step(refractory_s):
    """A step of 2 nat at C = 0.1: the counts per frame measured on v2e itself."""
    frames = torch.full((16, 1, 1), math.exp(-0.2))
    frames[0] = math.exp(-2.2)
    sensor = EventSensor(0.1, stamps="v2e", refractory_s=refractory_s)
    per_frame = sensor.voxels(frames[None, None], FPS).sum((0, 1, 3, 4, 5)).int().tolist()
    want = [10, 10] if refractory_s < 0.001 else [2, 2, 1, 2, 1, 2]
    assert per_frame[: len(want)] == want
    assert sum(per_frame) == 20


def test_v2es_stamps_are_set_by_the_pixel_of_most_events():
    frames = torch.tensor([[0.1, 0.5], [0.9, 0.5 * math.exp(0.25)]])[:, None]
    events = EventSensor(0.2, stamps="v2e", refractory_s=0.0).events(frames, FPS)
    quiet = events[events["x"] == 1]
    assert quiet["t"].tolist() == [math.ceil(EDGES[1] / 10) - 1]


def test_levels_are_the_logarithm_to_one_unit():
    x = torch.rand(20000, dtype=torch.float32) * 0.99 + 0.01
    for source, light in (("linear", x.double()), ("srgb", ((x.double() + 0.055) / 1.055) ** 2.4)):
        seen = x >= 0.05
        level = read_levels(response.response_table("log", source, 1e-3), x)[seen]
        exact = light[seen].clamp(min=1e-3).log() * 2**20
        assert (level - exact).abs().max() < 1.1


@pytest.mark.parametrize(
    ("settings_", "words"),
    [
        ({"threshold": -1}, r"sensor.threshold must be in \[0.01, 5\], got -1"),
        ({"threshold": [0.7, 0.1]}, r"sensor.threshold must be a number or \[low, high\]"),
        ({"refractory_s": -1.0}, "sensor.refractory_s"),
        ({"refractory": "drop"}, "sensor.refractory must be one of defer, delete, hold"),
        ({"stamps": "esim"}, "sensor.stamps"),
        ({"mismatch": math.nan}, "sensor.mismatch"),
        ({"floor": 0.0}, "sensor.floor"),
        ({"random_share": -0.1}, r"sensor.random_share must be in \[0, 1\], got -0.1"),
        ({"random_share": 1.1}, r"sensor.random_share must be in \[0, 1\], got 1.1"),
        ({"random_share": math.nan}, r"sensor.random_share must be in \[0, 1\], got nan"),
        ({"refractory_s": True}, r"sensor.refractory_s must be in \[0, 10\], got True"),
        ({"random": {"refractory_s": [False, True]}}, "sensor.random.refractory_s must be"),
    ],
)
def test_settings_outside_their_range_are_named(settings_, words):
    with pytest.raises(ValueError, match=words):
        EventSensor(**settings_)


@pytest.mark.parametrize("threshold", [["a", "b"], [[0.1, 0.2], 0.3], [0.1], [], "a", None, True])
def test_a_threshold_that_is_no_number_and_no_range_is_named(threshold):
    with pytest.raises(ValueError, match=r"^sensor.threshold must be a number or \[low, high\], l"):
        threshold_range(threshold)


@pytest.mark.parametrize(
    ("frames", "fps", "words"),
    [
        (torch.rand(1, 4, 4), FPS, "two frames|at least 2 frames"),
        (torch.rand(3, 4, 4) - 0.5, FPS, "finite and in"),
        (torch.rand(3, 4, 4) * 3, FPS, "finite and in"),
        (torch.full((3, 4, 4), math.nan), FPS, "finite and in"),
        (torch.rand(3, 4, 4), -1.0, "fps must be in"),
        (torch.rand(3, 0, 4), FPS, "at least one pixel"),
    ],
)
def test_frames_that_are_wrong_are_named(frames, fps, words):
    with pytest.raises(ValueError, match=words):
        EventSensor().events(frames, fps)


def test_black_pixels_are_at_the_floor():
    frames = torch.zeros(2, 1, 1)
    frames[1] = 1 / 255
    assert len(EventSensor(0.05).events(frames, FPS)) == 0


def test_a_clips_sensor_is_drawn_within_the_ranges():
    ranges = {"threshold": [0.1, 0.6], "off_ratio": [0.8, 1.25], "mismatch": [0.0, 0.1]}
    sensor = EventSensor(0.2, dark_noise_hz=1.0, random=ranges)
    clips = [sensor.draw(key) for key in range(400)]
    for name, (low, high) in ranges.items():
        values = np.array([getattr(clip, name) for clip in clips])
        assert low <= values.min() and values.max() <= high and len(set(values)) > 390
        middle = np.sqrt(low * high) if low > 0 else high / 2  # log-uniform, or uniform
        assert 0.4 < (values < middle).mean() < 0.6  # 0.5 +- 0.025
    assert clips[0].random == {} and clips[0].dark_noise_hz == 1.0 and clips[0].seed == sensor.seed
    assert sensor.draw(3).threshold == clips[3].threshold and sensor.draw(3, 7).seed == 7


def test_what_is_not_drawn_is_drawn_as_before():
    plain, more = EventSensor([0.1, 0.7]), EventSensor([0.1, 0.7], random={"mismatch": [0, 0.1]})
    assert plain.draw(5).threshold == more.draw(5).threshold


def test_a_share_of_the_clips_keeps_the_sensors_own_numbers():
    ranges = {"mismatch": [0.01, 0.1], "refractory_s": [0.001, 0.002]}
    drawn = [EventSensor(random=ranges).draw(key) for key in range(400)]
    some = [EventSensor(random=ranges, random_share=0.7).draw(key) for key in range(400)]
    kept = [clip.mismatch == 0.0 for clip in some]
    assert 0.23 < np.mean(kept) < 0.37  # 0.3 +- 0.023
    for clip, before, own in zip(some, drawn, kept, strict=True):
        expected = (0.0, 0.005) if own else (before.mismatch, before.refractory_s)
        assert (clip.mismatch, clip.refractory_s) == expected


@pytest.mark.parametrize(
    ("ranges", "message"),
    [
        ({"color": [0, 1]}, "sensor.random must hold ranges of threshold, .*, got color"),
        ({"floor": [0.01, 0.1]}, "sensor.random must hold ranges of .*, got floor"),
        ({"threshold": 0.2}, r"threshold must be \[low, high\], low <= high, got 0.2"),
        ({"threshold": [0.5, 0.1]}, r"sensor.random.threshold must be \[low, high\]"),
        ({"threshold": ["a", "b"]}, r"sensor.random.threshold must be \[low, high\]"),
        ({"threshold": [0.1, 9]}, r"sensor.random.threshold must be in \[0.01, 5\], got 9"),
        ({"mismatch": [-1, 0.5]}, r"sensor.random.mismatch must be in \[0, 1\], got -1"),
    ],
)
def test_wrong_ranges_name_their_key(ranges, message):
    with pytest.raises(ValueError, match=message):
        EventSensor(random=ranges)


def test_with_a_reference_error_the_first_event_comes_anywhere_within_two_thresholds():
    """A ramp of log intensity: without, all pixels fire at the same moment, one threshold on."""
    ramp = torch.exp(torch.linspace(-2.0, -1.0, 101))[None, None, :, None, None]
    ramp = ramp.expand(-1, -1, -1, 64, 64).contiguous()
    firsts = []
    for error in (0.0, 1.0):
        sensor = EventSensor(0.2, refractory_s=0.0, initial_reference_error=error)
        counts = sensor.voxels(ramp, 100.0).sum(3)
        firsts.append((counts[0, 0] > 0).float().argmax(0).flatten())  # hundredths of a nat
    assert firsts[0].unique().numel() == 1
    waited = (firsts[1] + 0.5) / 100
    assert waited.min() < 0.01 and waited.max() > 0.38
    assert float(waited.mean()) == pytest.approx(0.2, abs=0.01)


def test_a_reference_error_makes_no_event_by_itself_and_is_the_same_in_a_crop_and_in_a_list():
    still = torch.full((1, 2, 4, 32, 32), 0.4)
    sensor = EventSensor(0.2, initial_reference_error=1.0, mismatch=0.3, refractory_s=0.0)
    assert float(sensor.voxels(still, 100.0).abs().sum()) == 0
    moving = still * torch.linspace(1, 2, 4)[:, None, None]
    whole = sensor.voxels(moving, 100.0, clips=[3])
    crop = sensor.voxels(moving[..., 8:24, 8:24], 100.0, clips=[3], origin=(8, 8), full_width=32)
    assert torch.equal(whole[..., 8:24, 8:24], crop) and float(crop.abs().sum()) > 100
    listed = sensor.events(moving[0, 1], 100.0, clip=3, view=1)
    assert int(listed["p"].sum()) == pytest.approx(float(whole[0, 1].sum()))
