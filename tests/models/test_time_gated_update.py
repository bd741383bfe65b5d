"""The update of SetNet's memory: its own gradient."""

import pytest
import torch

from src.models.time_gated_update import TimeGatedUpdate, time_gated_update


@pytest.mark.parametrize("kind", [torch.float32, torch.bfloat16])
def test_its_gradients_are_autograd_s(kind):
    drawer = torch.Generator().manual_seed(0)
    both = torch.randn(2, 6, 5, 4, generator=drawer).to(kind)
    both = both.contiguous(memory_format=torch.channels_last)
    state = torch.rand(2, 3, 5, 4, generator=drawer)
    elapsed = torch.tensor([0.7, 0.0]).reshape(2, 1, 1, 1)
    slope = torch.randn(2, 3, 5, 4, generator=drawer)

    def gradients(update) -> tuple[torch.Tensor, ...]:
        leaves = both.clone().requires_grad_(), state.clone().requires_grad_()
        after = update(*leaves, elapsed)
        return after, *torch.autograd.grad(after, leaves, slope)

    ours, theirs = gradients(TimeGatedUpdate.apply), gradients(time_gated_update)
    assert torch.equal(ours[0], theirs[0])
    for mine, other in zip(ours[1:], theirs[1:], strict=True):
        assert mine.dtype == other.dtype
        torch.testing.assert_close(
            mine, other, rtol=2e-2 if kind == torch.bfloat16 else 1e-5, atol=1e-6
        )
    assert ours[1].is_contiguous(memory_format=torch.channels_last)
