"""The Pareto front, the one-standard-error rule and timing on what is known."""

import math

import pytest
import torch

from src.bench.speed import SpeedMeasurement
from src.bench.speed_accuracy import (
    ClipScore,
    find_fastest_forms,
    find_pareto_front,
    format_chart_summary,
    recommend_network_per_severity,
    select_by_one_standard_error,
)
from src.deploy.cost import time_frame
from src.models.network import EventToVideoNetwork


def test_the_front_holds_what_none_beats_in_both():
    points = {"a": (1.0, 5.0), "b": (2.0, 6.0), "c": (3.0, 1.0), "d": (3.0, 2.0), "e": (9.0, 1.0)}
    assert find_pareto_front(points) == ["a", "c"]


def test_the_choice_is_the_cheapest_within_one_standard_error():
    errors = {"best": [1.0, 2.0, 3.0], "near": [1.4, 2.1, 2.8], "worse": [1.1, 2.1, 3.1]}
    costs = {"best": 9.0, "near": 3.0, "worse": 1.0}  # worse on every clip, if by little
    assert select_by_one_standard_error(costs, errors) == "near"


def test_a_network_costs_what_its_fastest_form_takes_on_one_thread():
    def timed(network, form, ms, side=64, threads=1):
        return SpeedMeasurement(network, True, 9, side, "cpu", threads, form, ms=ms)

    speeds = [timed("a", "float32", 5.0), timed("a", "openvino", 2.0), timed("b", "float32", 3.0)]
    speeds += [timed("b", "openvino", None), timed("b", "bf16", 1.0, threads=2)]
    speeds += [timed("b", "bf16", 1.0, side=32)]
    found = find_fastest_forms(speeds, 64)
    assert {name: s.form for name, s in found.items()} == {"a": "openvino", "b": "float32"}
    scores = [ClipScore(name, "weak", clip, {"ssim": 0.5}) for name in "ab" for clip in (0, 1)]
    assert recommend_network_per_severity(speeds, scores, 64) == {"weak": "a"}
    assert recommend_network_per_severity(speeds, scores[::2], 64) == {}, "of one clip each"


@pytest.mark.parametrize("wrong", [math.nan, math.inf, None])
def test_a_network_without_a_finite_score_is_left_out_with_a_line(wrong):
    speeds = [SpeedMeasurement(name, True, 9, 64, "cpu", 1, "float32", ms=1.0) for name in "ab"]
    scores = [ClipScore("a", "weak", clip, {"lpips": 0.3}) for clip in (0, 1)]
    scores += [
        ClipScore("b", "weak", clip, {"lpips": value}) for clip, value in ((0, 0), (1, wrong))
    ]
    recommended = recommend_network_per_severity(speeds, scores, 64)
    assert recommended == {"weak": "a"}
    text = format_chart_summary(speeds, scores, recommended, 64)
    assert "- weak turbulence: not every clip has a finite score of b.\n" in text
    assert recommend_network_per_severity(speeds, scores[2:], 64) == {}


class Doubling(EventToVideoNetwork):
    """Computes as little as a network can."""

    views = None

    def forward(self, voxels, state=None, **_):
        return torch.cat([voxels, voxels]).sum().view(1, 1, 1, 1), voxels.sum()


def test_a_frame_is_timed_in_thread_time_on_one_thread():
    took = time_frame(Doubling(), torch.zeros(1, 1, 5, 64, 64))
    assert took.clock == "thread" and took.frames == 5 and 0 <= took.least_ms <= took.median_ms
    assert time_frame(Doubling(), torch.zeros(1, 1, 1, 8, 8), threads=2).clock == "wall"
