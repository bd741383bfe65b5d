"""A bad batch is named and does not move the weights; a spike moves them no more than usual."""

import pytest
import torch

from src.training.step_guard import NonFiniteError, StepGuard


def test_a_spike_counts_no_more_than_the_median():
    guard = StepGuard(10.0, min_losses=4)
    assert [guard.gradient_scale(loss) for loss in (1.0, 2.0, 500.0, 3.0)] == [1.0] * 4
    assert guard.gradient_scale(100.0) == pytest.approx(2.5 / 100)
    assert guard.gradient_scale(24.0) == 1.0, "a spike must not become usual"
    off = StepGuard(None, min_losses=1)
    assert [off.gradient_scale(loss) for loss in (1.0, 1e9)] == [1.0, 1.0]


def test_a_lasting_change_becomes_usual():
    guard = StepGuard(10.0)
    for loss, steps, last in ((0.1, 100, 1.0), (1.5, 49, 0.1 / 1.5), (1.5, 60, 1.0)):
        scales = [guard.gradient_scale(loss) for _ in range(steps)]
        assert scales[-1] == pytest.approx(last)


def test_gradients_are_limited_by_both():
    guard, loss = StepGuard(10.0, 0.5, min_losses=1), torch.tensor(1.0)
    first, second = [torch.full((4,), 1.0)], [torch.full((4,), 1.0)]
    guard.scale_gradients(first, loss, 0, [])
    assert float(first[0].norm()) == pytest.approx(0.5)
    guard.scale_gradients(second, 100 * loss, 1, [])
    assert float(second[0].norm()) == pytest.approx(0.02), "after the spike it is short enough"


def test_factors_that_would_always_act_are_refused():
    with pytest.raises(ValueError, match="loss_spike_factor must be > 1"):
        StepGuard(1.0)
    with pytest.raises(ValueError, match="grad_clip_norm must be > 0"):
        StepGuard(None, 0.0)


def test_the_error_names_the_clips():
    clips = [{"clip": 14, "threshold": 0.2}, {"clip": 15}]
    with pytest.raises(NonFiniteError, match="step 7.*'threshold': 0.2") as caught:
        StepGuard().scale_gradients([torch.zeros(2)], torch.tensor(float("nan")), 7, clips)
    assert caught.value.clips == [14, 15]
    with pytest.raises(NonFiniteError, match="a gradient is not finite"):
        StepGuard().scale_gradients(
            [torch.tensor([1.0, float("inf")])], torch.tensor(1.0), 7, clips
        )
