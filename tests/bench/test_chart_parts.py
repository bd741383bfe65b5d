"""The front, the knee and the stopwatch on what is known."""

import pytest
import torch
from torch import nn

from src.bench import timing
from src.bench.pareto import front, knee, standard_error
from src.models import stopwatch


def test_the_front_holds_what_none_beats_in_both():
    points = {"a": (1.0, 5.0), "b": (2.0, 6.0), "c": (3.0, 1.0), "d": (3.0, 2.0), "e": (9.0, 1.0)}
    assert front(points) == ["a", "c"]


def test_the_knee_is_the_cheapest_within_one_standard_error():
    errors = {"best": [1.0, 2.0, 3.0], "near": [1.5, 2.5, 3.5], "far": [3.0, 3.0, 3.0]}
    costs = {"best": 9.0, "near": 3.0, "far": 1.0}
    assert standard_error(errors["best"]) == pytest.approx(1 / 3**0.5)
    assert knee(costs, errors) == "near"
    assert knee(costs, {"best": [1.0], "near": [1.1]}) == "best"


class Doubling(nn.Module):
    """Makes one tensor of twice the input's bytes and drops it again."""

    views = None

    def forward(self, voxels, state=None):
        return torch.cat([voxels, voxels]).sum().view(1, 1, 1, 1), voxels.sum()


def test_peak_memory_counts_what_is_alive_at_once():
    voxels = torch.zeros(1, 1, 5, 64, 64)
    size = voxels.numel() * 4
    assert 3 * size <= timing.peak_bytes(Doubling(), voxels) < 3.1 * size


def test_a_frame_is_timed_in_thread_time_on_one_thread():
    took = stopwatch.frame(Doubling(), torch.zeros(1, 1, 5, 64, 64), seconds=0.01)
    assert took.clock == "thread" and took.frames >= 3 and 0 <= took.least_ms <= took.median_ms
    assert stopwatch.frame(Doubling(), torch.zeros(1, 1, 1, 8, 8), count=2).clock == "wall"
