"""The update of SetNet's memory, in continuous time, and its gradient in half as many operators."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import FunctionCtx


def time_gated_update(
    gates_and_candidate: Float[Tensor, "n c2 h w"],
    state: Float[Tensor, "n c h w"],
    elapsed_windows: Float[Tensor, "n 1 _h _w"],
) -> Float[Tensor, "n c h w"]:
    """Return s' = tanh(a) + k (s - tanh(a)) with k = exp(-elapsed_windows relu(g)), float32.

    `gates_and_candidate`: g, then a, along the channels; `elapsed_windows`: in windows of 1/120 s.
    """
    gate, candidate = gates_and_candidate.float().chunk(2, 1)
    return torch.lerp(candidate.tanh(), state, torch.exp(-elapsed_windows * gate.relu()))


class TimeGatedUpdate(torch.autograd.Function):
    """`time_gated_update` for training, in the memory layout of its input.

    With c = tanh(a): ds = k ds', da = (1 - k) (1 - c^2) ds' and, where g > 0, dg =
    -elapsed_windows k (s - c) ds'.
    """

    @staticmethod
    def forward(
        ctx: FunctionCtx, gates_and_candidate: Tensor, state: Tensor, elapsed_windows: Tensor
    ) -> Tensor:
        gate, candidate = gates_and_candidate.float().chunk(2, 1)
        keep, candidate = gate.relu().mul_(-elapsed_windows).exp_(), candidate.tanh()
        ctx.save_for_backward(gate > 0, candidate, state, keep, elapsed_windows)
        last = gates_and_candidate.is_contiguous(memory_format=torch.channels_last)
        layout = torch.channels_last if last else torch.contiguous_format
        ctx.dtype_and_layout = gates_and_candidate.dtype, layout  # type: ignore[attr-defined]
        return torch.lerp(candidate, state, keep)

    @staticmethod
    def backward(ctx: FunctionCtx, gradient: Tensor) -> tuple[Tensor, Tensor, None]:  # type: ignore[override]
        is_open, candidate, state, keep, elapsed_windows = ctx.saved_tensors  # type: ignore[attr-defined]
        dtype, layout = ctx.dtype_and_layout  # type: ignore[attr-defined]
        gradient = gradient.contiguous(memory_format=layout)  # or every operator would convert it
        kept = gradient * keep
        gates = (state - candidate).mul_(kept).mul_(-elapsed_windows).mul_(is_open)
        candidates = (gradient - kept).mul_(1 - candidate.square())
        return torch.cat([gates, candidates], 1).to(dtype, memory_format=layout), kept, None
