"""The front of a dart: a path that strays by a known amount, a trail, a clip too short to tell."""

import math

import pytest
import torch

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import StressBench
from src.bench.stress_tests.trajectory import (
    measure_cross_track_error,
    measure_trajectory_deviation,
)
from src.sim.optics import Optics
from src.sim.pipeline import Pipeline
from src.sim.scenes.targets import Targets
from src.sim.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence
from tests.bench.stress_tests.test_stress_tests import Running

SIDE, FRAMES = 128, 100


def film(stray: float = 0.0, trail: float = 0.0) -> torch.Tensor:
    """A blob that flies level, above and below its line by `stray` in turns of 12 frames."""
    y, x = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    shown, frames = torch.zeros(SIDE, SIDE), []
    for k in range(FRAMES):
        row = 64 + stray * math.copysign(1, math.sin(math.pi * (k + 0.5) / 12))
        blob = torch.exp(-((x - 5 - 1.2 * k) ** 2 + (y - row) ** 2) / 18)
        shown = torch.maximum(trail * shown, blob)
        frames.append(shown)
    return torch.stack(frames)


def measure_cross_track_error_px(frames: torch.Tensor, truth: torch.Tensor) -> float:
    found = measure_cross_track_error(frames, truth)
    assert found.lost_share == 0
    return found.px


def test_a_straight_flight_does_not_stray():
    assert measure_cross_track_error_px(film(), film()) < 0.01


def test_a_target_that_is_not_there_is_lost():
    noise = torch.rand(FRAMES, SIDE, SIDE, generator=torch.Generator().manual_seed(0))
    brightening = (0.005 * torch.arange(FRAMES))[:, None, None].expand(-1, SIDE, SIDE)
    for empty in (noise, brightening, torch.zeros(FRAMES, SIDE, SIDE), 1 - film()):
        found = measure_cross_track_error(empty, film())
        assert found.lost_share == 1 and math.isnan(found.px)


def test_of_a_target_that_vanishes_the_frames_before_count():
    half = film(stray=1.0)
    half[60:] = half[60:] * 0 + 0.5
    found, whole = (measure_cross_track_error(frames, film()) for frames in (half, film(stray=1.0)))
    assert 0.3 < found.lost_share < 0.8 and found.px == pytest.approx(whole.px, rel=0.3)


def test_a_front_that_strays_is_measured():
    assert measure_cross_track_error_px(film(stray=1.0), film()) == pytest.approx(1.0, rel=0.25)
    assert measure_cross_track_error_px(
        film(stray=2.0), film()
    ) > 1.7 * measure_cross_track_error_px(film(stray=1.0), film())


def test_a_trail_that_stays_does_not_count():
    assert measure_cross_track_error_px(film(trail=0.98), film()) < 0.05


def test_a_clip_that_shows_too_little_of_a_flight_is_named():
    with pytest.raises(ValueError, match=r"data\.test_windows must show more of a flight"):
        measure_cross_track_error_px(film()[:40], film()[:40])


def test_a_network_is_compared_with_no_turbulence_and_with_the_light():
    scene = Targets(
        kinds=["dart"], height=SIDE, width=SIDE, frames=61, fps=12_000.0, split="test",
        options={"dart": {"speed_px_per_s": 16_000.0, "dart_length": 0.25}},
    )  # fmt: skip
    air = SimulatedTurbulence({"severity": "strong", "width_px": SIDE})
    pipeline = Pipeline(scene, Optics(1), air, EventSensor(0.2), split="test")
    subject, bench = Candidate("running", Running(), 1), StressBench(pipeline, [0], 0)
    found = measure_trajectory_deviation(subject, bench, limit_px=0.3)
    long = measure_trajectory_deviation(subject, bench, limit_px=0.3, window_length="trained")
    assert long.value == pytest.approx(found.value, abs=0.01)  # of a sum of all events
    (still, calm), (light, seen), (mean, value), (clip, stray) = found.unjudged
    assert (still, light) == ("no turbulence (0 % lost)", "light of one view (0 % lost)")
    assert (mean, clip) == ("mean (0 % lost)", "clip 0 (0 % lost)")
    assert found.value == value == stray and calm < 0.2 and seen > calm
