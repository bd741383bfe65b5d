"""Event clips against the pipeline; results; networks whose result of a stress test is known."""

import csv
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from torch import nn

from baselines.highpass import HighPass
from src.bench.candidates import Candidate
from src.bench.stress_tests import (
    conditions,
    event_clips,
    faults,
    recurrence,
    static_camera,
    stress_results,
)
from src.bench.stress_tests.event_clips import ClipConditions, StressBench, simulate_event_clip
from src.bench.stress_tests.stress_results import StressResult
from src.models.network import EventToVideoNetwork
from src.models.setnet import SetNet
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, simulate
from src.sim.scenes.photographs import Photographs
from src.sim.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence

FPS = 120.0


def pipeline(windows: int = 16, views: int = 9) -> Pipeline:
    scene = Photographs(split="test", height=64, width=64, frames=windows + 1)
    air = SimulatedTurbulence({"severity": "medium", "width_px": 64})
    options = {"split": "test", "crop": 32}
    return Pipeline(scene, Optics(views), air, EventSensor(0.15), **options)


@pytest.fixture(scope="module")
def bench() -> StressBench:
    return StressBench(pipeline(), [0], warmup=4)


one_view_shifted = partial(conditions.measure_view_shift_loss, judged_shift_px=2, limit_db=0.3)


class Running(EventToVideoNetwork):
    """The sum of all events of the centre view: never forgets, whatever the windows."""

    views = None

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.03))

    def forward(self, voxels, state=None, **_):
        change = voxels.float()[:, voxels.shape[1] // 2].sum(1, keepdim=True)
        state = change if state is None else state + change
        return 0.5 + self.gain * state, state


def running(views: int = 9) -> Candidate:
    return Candidate("running", Running(), views)


def test_a_clip_cut_at_its_own_rate_is_what_the_pipeline_makes(bench):
    sample = simulate(pipeline(), [0])
    clip = bench.clips()[0]
    assert torch.equal(clip.target[1:], sample.target[0, :, 0])
    torch.testing.assert_close(torch.cat(list(clip.windows())), sample.voxels[0], atol=2e-3, rtol=0)


def test_every_rate_shows_the_same_events(bench):
    clip = bench.clips()[0]

    def sum_at(rate: int) -> torch.Tensor:
        ends_us = torch.arange(round(clip.duration_s * rate) + 1).double() * 1e6 / rate
        return sum(clip.voxel_grids(*span.tolist()).sum() for span in ends_us.unfold(0, 2, 1))

    sums = [sum_at(rate) for rate in (30, 120, 1200)]
    torch.testing.assert_close(sums[0], sums[1], atol=1e-2, rtol=0)
    torch.testing.assert_close(sums[2], sums[1], atol=1e-2, rtol=0)


def test_a_still_scene_without_turbulence_makes_no_event(bench):
    found = simulate_event_clip(
        bench.pipeline, 0, ClipConditions(stop_after_share=0.0, d_over_r0=0.0)
    )
    assert sum(map(len, found.events)) == 0


def test_a_scene_that_stops_makes_no_event_afterwards(bench):
    found = simulate_event_clip(
        bench.pipeline, 0, ClipConditions(stop_after_share=0.5, d_over_r0=0.0)
    )
    half = int(0.5 * (len(found.target) - 1))
    assert all(torch.equal(frame, found.target[half]) for frame in found.target[half:])
    times = np.concatenate([events["t"] for events in found.events])
    assert 0 < times.max() <= 1e6 * (half / found.fps + 0.005)  # what dead time held back


@pytest.mark.parametrize(("value", "high", "failed"), [(2, False, True), (2, True, False)])
def test_a_result_fails_on_its_side(value, high, failed):
    assert StressResult(value, "dB", 1.0, higher_is_better=high).failed == failed


def test_what_is_not_a_number_fails_wherever_it_stands():
    for curve in ([(1, 0.1), (2, torch.nan)], [(1, torch.nan), (2, 0.1)]):
        found = stress_results.build_worst_psnr_loss_result(curve, limit_db=1.0, varied="")
        assert found.failed and found.value != found.value
    scores = torch.full((60,), torch.nan)
    assert recurrence.count_settling_windows(scores, 1.0) == torch.inf


def test_a_stress_clip_has_the_sensor_that_was_drawn():
    chain, expected = pipeline(), pipeline()
    chain.sensor = EventSensor(random={"off_ratio": [0.5, 0.8], "refractory_s": [0.01, 0.1]})
    expected.sensor = chain.draw(0).sensor
    found, plain = (simulate_event_clip(one, 0, ClipConditions()) for one in (chain, expected))
    assert expected.sensor.off_ratio < 1 and expected.sensor.refractory_s > 0.01
    assert all(map(np.array_equal, found.events, plain.events))


def test_nothing_known_is_a_failure_and_the_settings_that_fail_are_named():
    found = StressResult(torch.nan, "dB", 1.0, [(1, 0.5), (2, 1.5), (3, 0.2), (4, 2)], "px")
    assert found.failed and found.failing_settings == [2, 4]
    text = stress_results.format_summary_per_network({"a": {"net": found}}, {"a": "a"}, {})
    assert "limit at most 1; fails at px = 2, 4\n" in text


def test_a_loss_is_against_the_best_of_the_reference_and_the_settings_before():
    losses = event_clips.compute_losses_against_best(20.0, [(1, 21.0), (4, 23.0), (10, 20.5)])
    assert losses == [(1, -1.0), (4, -2.0), (10, 2.5)]
    unknown = event_clips.compute_losses_against_best(20.0, [(1, torch.nan), (4, 23.0)])
    assert all(loss != loss for _, loss in unknown)


def test_turbulence_that_helps_before_it_harms_costs_what_it_harms(bench, monkeypatch):
    scores = {0.0: 20.0, 4: 23.0, 10: 20.5}
    monkeypatch.setattr(bench, "mean_aligned_psnr", lambda _, given: scores[given.d_over_r0])
    settings = {"parameter": "d_over_r0", "values": [4, 10], "reference": {"d_over_r0": 0.0}}
    found = conditions.measure_worst_psnr_loss(running(), bench, limit_db=1.2, **settings)
    assert found.value == 2.5 and found.failed


@pytest.mark.parametrize(
    ("value", "limit", "text"),
    [
        (0.0204, 0.02, "0.0204"),
        (2.03, 2.0, "2.03"),
        (0.0041, 0.004, "4.1e-3"),
        (2.0, 2.0, "2.0"),
        (np.nextafter(0.02, 1), 0.02, "0.020000000000000004"),
        (0.5, 0.02, "0.50"),
        (0.0, 0.0, "0"),
        (0.334, 0.333, "0.334"),
        (0.0195, 0.0198, "0.019"),
        (0.3333333, 1 / 3, "0.33"),
        (float("nan"), 1.0, "–"),
        (float("inf"), 1.0, "∞"),
    ],
)
def test_a_value_does_not_read_as_the_limit_that_it_misses(value, limit, text):
    assert stress_results.format_value(value, limit) == text


def test_a_value_without_a_unit_has_no_blank_behind_it():
    outcomes = {name: {"net": StressResult(value, "", 0.02)} for name, value in
                (("a", 0.0204), ("b", 0.01))}  # fmt: skip
    text = stress_results.format_summary_per_network(outcomes, {"a": "a", "b": "b"}, {})
    assert "- a: 0.0204, limit at most 0.02\n" in text and "b (0.01)" in text


def test_a_reference_beyond_the_limit_is_no_failure_of_the_network():
    found = StressResult(2.0, "px", 1.0, varied="video", unjudged=[("light of one view", 3.0)])
    titles, outcomes = {"straight": "straight"}, {"straight": {"net": found}}
    text = stress_results.format_summary_per_network(outcomes, titles, {})
    assert "- straight: 2.0 px, limit at most 1\n" in text
    rows = csv.DictReader(stress_results.format_outcomes_csv(outcomes, titles).splitlines())
    assert [(row["setting"], row["failed"]) for row in rows] == [
        ("", "True"), ("light of one view", "")
    ]  # fmt: skip


def test_frames_whose_truth_is_uniform_have_no_aligned_psnr(bench):
    (clip,) = bench.clips()
    longer = torch.cat([clip.target, torch.full_like(clip.target, 0.5)])
    seen = replace(clip, target=longer, turbulent=longer)
    frames = (seen.truth + 0.1 * torch.randn(seen.truth.shape)).clamp(0, 1)
    whole, part = (bench.clip_aligned_psnr(frames[:n], c) for n, c in ((None, seen), (16, clip)))
    assert whole == pytest.approx(part, abs=1e-4)


def test_a_sum_holds_and_a_leaky_sum_does_not(bench):
    retention = partial(
        recurrence.measure_contrast_retention_percent, windows=[5, 50], limit_percent=90.0
    )
    assert retention(running(), bench).value == pytest.approx(100)
    kept = retention(Candidate("leaky", HighPass(), 1), bench)
    assert kept.curve[0][1] == pytest.approx(100 * 0.9**5, rel=0.02) and kept.failed


class Pausing(Running):
    """As Running; in a window without events, what `pause` makes of the last frame."""

    def __init__(self, pause):
        super().__init__()
        self.pause = pause

    def forward(self, voxels, state=None, **_):
        frame, state = super().forward(voxels, state)
        return (frame if voxels.any() else self.pause(frame)), state


@pytest.mark.parametrize(
    ("pause", "percent"),
    [
        (lambda frame: torch.rand(frame.shape), 0),
        (lambda frame: 1 - frame, -100),
        (lambda frame: 0.5 + 0.3 * (frame - 0.5), 30),
        (lambda frame: frame + (frame - 0.5).std() * torch.randn(frame.shape), 71),
        (lambda frame: torch.full_like(frame, 0.5), 0),
    ],
)
def test_contrast_is_kept_where_the_picture_is(bench, pause, percent):
    torch.manual_seed(0)
    network = Candidate("pausing", Pausing(pause), 9)
    network.loaded.gain.data /= 10  # within the range of frames
    options = {"windows": [3], "limit_percent": 90.0}
    found = recurrence.measure_contrast_retention_percent(network, bench, **options)
    assert found.value == pytest.approx(percent, abs=5) and found.failed


def test_contrast_of_frames_that_are_none_is_not_kept(bench):
    network = Candidate("none", Pausing(lambda frame: torch.full_like(frame, torch.nan)), 9)
    options = {"windows": [3], "limit_percent": 90.0}
    assert recurrence.measure_contrast_retention_percent(network, bench, **options).failed


@pytest.mark.parametrize("window_length", ["trained", "growing"])
def test_windows_of_any_length_end_with_the_same_events(bench, window_length):
    clip, network, asked = bench.clips()[0], running(), [7, 15, 40, 45]
    frames = clip.reconstruct_at_rate(network, 1200, asked, "frame")
    assert not torch.allclose(frames[0], frames[-1], atol=0.01)
    found = clip.reconstruct_at_rate(network, 1200, asked, window_length)
    torch.testing.assert_close(found, frames, atol=1e-3, rtol=0)


def test_a_sum_comes_back_at_any_rate_and_after_any_loop(bench):
    for grows, rates_hz in ((False, [60, 1200]), (True, [40, 6400])):
        rates, network = {"rates_hz": rates_hz, "duration_s": 0.2, "limit_db": 1.0}, running()
        network.loaded.uses_window_length = grows
        assert abs(conditions.measure_window_rate_loss(network, bench, **rates).value) < 1e-3
    drift = recurrence.measure_long_sequence_drift(running(), bench, windows=96, limit_db=1.0)
    assert abs(drift.value) < 1e-3


def test_a_difference_in_a_sum_neither_grows_nor_fades(bench):
    growth = partial(recurrence.measure_input_perturbation_growth, limit_growth_per_window=0.0)
    assert abs(growth(running(), bench).value) < 1e-3
    assert growth(Candidate("leaky", HighPass(), 1), bench).value < -0.05


def test_the_worst_input_of_a_sum_is_found(bench):
    sizes = {"windows": 3, "steps": 4, "limit_gain": 1.0}
    found = recurrence.measure_adversarial_gain(running(), bench, **sizes)
    # Five bins pull the same way; all that nine views may have goes into the one that is seen.
    assert found.value == pytest.approx(0.03 * 5 * 3, rel=1e-3)


class Blind(EventToVideoNetwork):
    """Half grey, whatever the events."""

    views = None

    def __init__(self):
        super().__init__()
        self.grey = nn.Parameter(torch.tensor(0.5))

    def forward(self, voxels, state=None, **_):
        size = voxels.shape[0], 1, *voxels.shape[-2:]
        return self.grey.expand(size), voxels.new_zeros(1)


def test_what_has_no_effect_neither_grows_nor_gains(bench):
    blind = Candidate("blind", Blind(), 9)
    growth = recurrence.measure_input_perturbation_growth(blind, bench, limit_growth_per_window=0.0)
    gain = recurrence.measure_adversarial_gain(blind, bench, windows=3, steps=2, limit_gain=1.0)
    assert growth.value == 0 and not growth.failed
    assert gain.value == 0 and not gain.failed
    blind.loaded.grey.requires_grad_(False)
    assert recurrence.measure_adversarial_gain(blind, bench, windows=3, limit_gain=1.0).value == 0


def test_frames_that_are_none_fail_every_test_of_the_state(bench):
    network = Candidate("none", Blind(), 9)
    network.loaded.grey.data.fill_(torch.nan)
    for measure, limit in (
        (recurrence.measure_convergence_windows, {"limit_windows": 1e9}),
        (recurrence.measure_flicker_recovery, {"limit_windows": 1e9}),
        (recurrence.measure_input_perturbation_growth, {"limit_growth_per_window": 1e9}),
    ):
        assert measure(network, bench, **limit).failed, measure


def test_what_looks_at_the_centre_alone_minds_no_other_view(bench):
    assert one_view_shifted(running(), bench).value == pytest.approx(0, abs=1e-6)


def test_turbulence_in_common_matters_only_to_what_looks_at_several_views(bench):
    common = {"spacings_over_aperture": [1.0, 0.0], "limit_db": 0.3}
    centre = conditions.measure_correlated_views_loss(running(), bench, **common)
    assert [loss for _, loss in centre.curve] == pytest.approx([0, 0], abs=1e-6)
    median = Candidate("median", HighPass(view_reduction="median"), 9)
    found = conditions.measure_correlated_views_loss(median, bench, **common)
    spaced, same = (abs(loss) for _, loss in found.curve)
    assert same > spaced > 0.01
    with pytest.raises(ValueError, match="the centre view only"):
        conditions.measure_correlated_views_loss(running(1), bench, **common)


def test_more_views_lost_than_there_are_is_said(bench):
    for views, said in ((1, "the centre view only"), (9, "9 views, 10 are needed")):
        with pytest.raises(ValueError, match=f"it is given {said}"):
            conditions.measure_worst_view_dropout_loss(
                running(views), bench, counts=[1, 9], limit_db=0.5
            )


@pytest.mark.parametrize("views", [2, 4])
def test_without_a_middle_the_centre_view_is_that_of_the_optics(views):
    bench, subject = (
        StressBench(pipeline(views=views), [0], 4),
        Candidate("centre", HighPass(), views),
    )
    lost = {"counts": [1], "draws": 1, "limit_db": 0.5}
    assert conditions.measure_worst_view_dropout_loss(subject, bench, **lost).value != 0
    assert one_view_shifted(subject, bench).value == 0


def test_the_view_beside_the_centre_is_one_the_network_sees(bench):
    subject = Candidate("four of nine", HighPass(view_reduction="median"), 4)
    assert one_view_shifted(subject, bench).value != 0


def test_only_a_fault_that_a_network_sees_costs_it_something(bench):
    # The running sum looks at the centre view alone.
    silent = faults.measure_silent_view_loss(running(), bench, limit_db=0.5)
    assert silent.curve[0][1] > 0.01 and silent.curve[1][1] == pytest.approx(0, abs=1e-6)
    assert silent.value == silent.curve[0][1]
    jump = {"jumps_ms": [8.0], "limit_db": 0.5}
    assert faults.measure_clock_jump_loss(running(), bench, **jump).value == pytest.approx(0)
    assert faults.measure_view_order_loss(running(), bench, limit_db=0.5).value == pytest.approx(0)
    median = Candidate("median", HighPass(view_reduction="median"), 9)
    assert faults.measure_clock_jump_loss(median, bench, **jump).value != 0


def test_a_fault_begins_in_the_middle_and_in_one_view(bench):
    (clip,) = bench.clips()
    half_us = clip.duration_s / 2 * 1e6
    changed = faults._change_view(running(), clip, 0, lambda e, half: e[e["t"] < half])
    for view, (before, after) in enumerate(zip(clip.events, changed.events, strict=True)):
        kept = before[before["t"] < half_us] if view == 4 else before
        assert len(kept) and np.array_equal(after, kept)


def test_a_lamp_makes_events_on_a_scene_that_stands_still(bench):
    still = ClipConditions(d_over_r0=0.0, stop_after_share=0.0)
    lit = ClipConditions(d_over_r0=0.0, stop_after_share=0.0, lamp_modulation_depth=0.4)
    plain, flickering = (simulate_event_clip(bench.pipeline, 0, one) for one in (still, lit))
    assert sum(map(len, plain.events)) == 0 and min(map(len, flickering.events)) > 100
    signs = flickering.events[4]["p"] > 0
    assert 0.3 < signs.mean() < 0.7 and torch.equal(plain.target, flickering.target)


def test_every_stress_test_runs_on_a_set_network():
    torch.manual_seed(0)
    bench = StressBench(pipeline(windows=8), [0], warmup=2)
    subject = Candidate("setnet", SetNet(channels=4).eval(), 9)
    tests = {
        recurrence.measure_contrast_retention_percent: {"windows": [3], "limit_percent": 1.0},
        recurrence.measure_long_sequence_drift: {"windows": 48, "limit_db": 1.0},
        recurrence.measure_convergence_windows: {"limit_windows": 1.0},
        recurrence.measure_flicker_recovery: {"limit_windows": 1.0},
        recurrence.measure_static_scene_jitter_percent: {"limit_percent": 1.0},
        recurrence.measure_input_perturbation_growth: {"limit_growth_per_window": 1.0},
        recurrence.measure_adversarial_gain: {"windows": 2, "steps": 2, "limit_gain": 1.0},
        recurrence.measure_bf16_psnr_difference: {"windows": 8, "limit_db": 1.0},
        conditions.measure_window_rate_loss: {
            "rates_hz": [1200],
            "duration_s": 0.05,
            "limit_db": 1.0,
        },
        conditions.measure_voxel_dropout_loss: {"kept_shares": [0.1], "limit_db": 1.0},
        conditions.measure_worst_view_dropout_loss: {"counts": [4], "draws": 1, "limit_db": 1.0},
        conditions.measure_view_shift_loss: {
            "judged_shift_px": 1,
            "parallax": True,
            "limit_db": 1.0,
        },
        faults.measure_silent_view_loss: {"limit_db": 1.0},
        faults.measure_clock_jump_loss: {"jumps_ms": [8.0], "limit_db": 1.0},
        faults.measure_view_order_loss: {"limit_db": 1.0},
        conditions.measure_correlated_views_loss: {
            "spacings_over_aperture": [0.0],
            "limit_db": 1.0,
        },
        conditions.measure_worst_psnr_loss: {
            "parameter": "sensor.threshold",
            "values": [0.3],
            "limit_db": 1.0,
        },
    }
    for measure, settings in tests.items():
        found = measure(subject, bench, **settings)
        assert found.value == found.value and found.limit is not None, measure
    for name, value in (("view_log_gain_std", 0.05), ("lamp_modulation_depth", 0.2)):
        varied = {"parameter": name, "values": [value], "limit_db": 1.0}
        found = conditions.measure_worst_psnr_loss(subject, bench, **varied)
        assert found.value == found.value


def test_settling_is_the_last_time_beyond():
    scores = torch.cat([torch.linspace(0, 20, 21), torch.full((39,), 20.0)])
    assert recurrence.count_settling_windows(scores, 1.0) == 18  # averaged over five windows
    assert recurrence.count_windows_to_last_exceedance(torch.tensor([3.0, 0.5, 2.0, 0.5]), 1.0) == 3
    assert recurrence.count_settling_windows(torch.linspace(0, 20, 60), 1.0) == torch.inf
    for last in (2.0, torch.nan):
        losses = torch.tensor([3.0, 0.5, last])
        assert recurrence.count_windows_to_last_exceedance(losses, 1.0) == torch.inf


class Cloudy(Running):
    """As Running, on a background that is darker on the left by a quarter."""

    def forward(self, voxels, state=None, **_):
        frame, state = super().forward(voxels, state)
        clouds = torch.where(torch.arange(frame.shape[-1]) < frame.shape[-1] // 2, -0.125, 0.125)
        return frame + clouds, state


def test_a_background_of_one_value_invents_nothing(bench):
    options = {"limit_share": 0.02, "sizes": [[96, 128]], "windows": 6}
    plain = static_camera.measure_invented_contrast(running(), bench, **options)
    cloudy = Candidate("cloudy", Cloudy(), 9)
    found = static_camera.measure_invented_contrast(cloudy, bench, **options)
    assert plain.value < 1e-6 and not plain.failed
    assert found.value > 0.05 and found.failed
