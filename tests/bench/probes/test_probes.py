"""Streams against the pipeline; findings; networks whose answer to a probe is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from baselines.highpass import HighPass
from src.bench.candidates import Subject
from src.bench.probes import air, light_field, memory, numerics, sampling
from src.bench.probes.clips import Conditions, film, strengthened
from src.bench.probes.standard import Bench, Finding
from src.models.setnet import SetNet
from src.sim.noise import generator
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline, simulate
from src.sim.scenes.photographs import Photographs
from src.sim.turbulence import sample_atmosphere
from src.sim.turbulence.simulated import SimulatedAir

FPS = 120.0


def pipeline(windows: int = 16, views: int = 9) -> Pipeline:
    scene = Photographs(split="test", height=64, width=64, frames=windows + 1)
    air = SimulatedAir({"severity": "medium", "width_px": 64})
    options = {"split": "test", "crop": 32}
    return Pipeline(scene, Optics(views), air, {"threshold": 0.15}, **options)


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(pipeline(), [0], warmup=4)


class Running(nn.Module):
    """The sum of all events of the centre view: never forgets, whatever the windows."""

    views = None

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(0.03))

    def forward(self, voxels, state=None):
        change = voxels.float()[:, voxels.shape[1] // 2].sum(1, keepdim=True)
        state = change if state is None else state + change
        return 0.5 + self.gain * state, state


def running(views: int = 9) -> Subject:
    return Subject("running", Running(), views)


def test_a_stream_cut_at_its_own_rate_is_what_the_pipeline_makes(bench):
    sample = simulate(pipeline(), [0])
    stream = bench.streams()[0]
    assert torch.equal(stream.target[1:], sample.target[0, :, 0])
    torch.testing.assert_close(stream.voxels()[0], sample.voxels[0], atol=2e-3, rtol=0)


def test_every_rate_shows_the_same_events(bench):
    stream = bench.streams()[0]
    sums = [sum(w.sum() for w in stream.windows(rate)) for rate in (30, 120, 1200)]
    torch.testing.assert_close(sums[0], sums[1], atol=1e-2, rtol=0)
    torch.testing.assert_close(sums[2], sums[1], atol=1e-2, rtol=0)


def test_a_still_scene_without_turbulence_makes_no_event(bench):
    found = film(bench.pipeline, 0, Conditions(moves=0.0, d_over_r0=0.0))
    assert sum(map(len, found.events)) == 0


def test_a_scene_that_stops_makes_no_event_afterwards(bench):
    found = film(bench.pipeline, 0, Conditions(moves=0.5, d_over_r0=0.0))
    half = int(0.5 * (len(found.target) - 1))
    assert all(torch.equal(frame, found.target[half]) for frame in found.target[half:])
    times = np.concatenate([events["t"] for events in found.events])
    assert 0 < times.max() <= 1e6 * (half / found.fps + 0.005)  # what dead time held back


def test_strength_is_set_exactly():
    drawn = sample_atmosphere("medium", generator(1))
    assert strengthened(drawn, 7.0).d_over_r0 == pytest.approx(7.0)
    assert strengthened(drawn, 0.0) is None
    profile = replace(drawn, cn2=(3e-14, 1e-14, 2e-14))
    assert strengthened(profile, 7.0).d_over_r0 == pytest.approx(7.0)


@pytest.mark.parametrize(("value", "high", "failed"), [(2, False, True), (2, True, False)])
def test_a_finding_fails_on_its_side(value, high, failed):
    assert Finding(value, "dB", 1.0, high=high).failed == failed


def test_nothing_known_is_a_failure_and_the_first_break_is_found():
    found = Finding(float("nan"), "dB", 1.0, [(1, 0.5), (2, 1.5), (3, 0.2)])
    assert found.failed and found.breaks_at == 2


def test_a_sum_holds_and_a_leaky_sum_does_not(bench):
    hold = memory.Hold(windows=[5, 50])
    assert hold(running(), bench).value == pytest.approx(100)
    kept = hold(Subject("leaky", HighPass(), 1), bench)
    assert kept.curve[0][1] == pytest.approx(100 * 0.9**5, rel=0.02) and kept.failed


def test_a_sum_comes_back_at_any_rate_and_after_any_loop(bench):
    assert abs(sampling.Rates(rates=[60, 1200], seconds=0.2)(running(), bench).value) < 1e-3
    assert abs(memory.LongRun(windows=96)(running(), bench).value) < 1e-3


def test_a_difference_in_a_sum_neither_grows_nor_fades(bench):
    assert abs(numerics.Growth()(running(), bench).value) < 1e-3
    assert numerics.Growth()(Subject("leaky", HighPass(), 1), bench).value < -0.05


def test_the_worst_input_of_a_sum_is_found(bench):
    found = numerics.WorstInput(windows=3, steps=4)(running(), bench)
    # Five bins pull the same way; all that nine views may have goes into the one that is seen.
    assert found.value == pytest.approx(0.03 * 5 * 3, rel=1e-3)


def test_what_looks_at_the_centre_alone_minds_no_other_view(bench):
    subject = running()
    assert light_field.Misplaced()(subject, bench).value == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("views", [2, 4])
def test_without_a_middle_the_centre_view_is_that_of_the_optics(views):
    bench, subject = Bench(pipeline(views=views), [0], 4), Subject("centre", HighPass(), views)
    assert light_field.Lost([1], 1)(subject, bench).value != 0  # the centre view is the one lost
    assert light_field.Misplaced()(subject, bench).value == 0


def test_the_view_beside_the_centre_is_one_the_network_sees(bench):
    subject = Subject("four of nine", HighPass(source="median"), 4)
    assert light_field.Misplaced()(subject, bench).value != 0


def test_every_probe_runs_on_a_set_network(bench):
    torch.manual_seed(0)
    subject = Subject("setnet", SetNet(half=4).eval(), 9)
    probes = [
        memory.Hold([3]), memory.LongRun(96), memory.StartUp(), memory.Shock(), memory.Still(),
        sampling.Rates([1200], 0.1), sampling.Thresholds([0.3]), sampling.FewerEvents([0.1]),
        light_field.Lost([4], 1),
        light_field.Misplaced([2]), light_field.Parallax([1]),
        numerics.Growth(),
        numerics.WorstInput(2, 2), numerics.Bf16(8), air.SharedAir([0.0]), air.Gain([0.05]),
    ]  # fmt: skip
    for probe in probes:
        found = probe(subject, bench)
        assert found.value == found.value and found.limit is not None, probe
    assert numerics.Chunked()(subject, bench).value == 0


def test_shifting_brings_nothing_in():
    voxels = torch.ones(1, 9, 5, 8, 8)
    moved = light_field.shifted(voxels, {2: (1, -2)})
    assert moved[:, 2].sum() == 5 * 7 * 6 and torch.equal(moved[:, 3], voxels[:, 3])
    assert not moved[0, 2, 0, 0].any() and not moved[0, 2, 0, :, -2:].any()


def test_settling_is_the_last_time_beyond():
    scores = torch.cat([torch.linspace(0, 20, 21), torch.full((39,), 20.0)])
    assert memory.settled(scores, 1.0) == 18  # averaged over five windows
    assert memory.last_beyond(torch.tensor([3.0, 0.5, 2.0, 0.5]), 1.0) == 3
