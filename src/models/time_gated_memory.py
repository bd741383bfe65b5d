"""SetNet's recurrent cell, in continuous time."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from src.models.layers import require_bias, scan_windows
from src.models.time_gated_update import TimeGatedUpdate, time_gated_update

Maps = Float[Tensor, "m c h2 w2"]


class TimeGatedMemory(nn.Module):
    """A recurrent cell with a gate and a candidate in continuous time (`time_gated_update`).

    s' = k s + (1 - k) tanh(candidate), k = exp(-t relu(gate)), t in units of 1/120 s: with
    t = 0 or gate <= 0 the state is held.  The input enters by 3 x 3, the state by 1 x 1
    convolutions, so that nothing spreads in space over time.  `gate_rank`: the 3 x 3 convolution is
    factored into 3 x 3 to so many channels and 1 x 1, which costs less (None: not factored).
    """

    def __init__(self, channels: int, gate_rank: int | None = None):
        super().__init__()
        inputs, size = (gate_rank, 1) if gate_rank else (channels, 3)
        self.input_features = (
            nn.Conv2d(channels, gate_rank, 3, padding=1, bias=False) if gate_rank else nn.Identity()
        )
        self.input_gates = nn.Conv2d(inputs, 2 * channels, size, padding=size // 2)
        self.state_gates = nn.Conv2d(channels, 2 * channels, 1, bias=False)
        with torch.no_grad():  # initial time constants of 1.4 to 20 windows of 1/120 s
            require_bias(self.input_gates)[:channels].copy_(torch.linspace(0.05, 0.7, channels))

    def forward(
        self, x: Maps, state: Float[Tensor, "n c h2 w2"], elapsed: Float[Tensor, "m 1 _h _w"]
    ) -> tuple[Maps, Float[Tensor, "n c h2 w2"]]:
        """Return the state, float32, after each of m = windows * n steps and after the last."""
        update = TimeGatedUpdate.apply if torch.is_grad_enabled() else time_gated_update

        def step(state: Tensor, from_input: Tensor, elapsed: Tensor) -> Tensor:
            return update(from_input + self.state_gates(state.to(x.dtype)), state, elapsed)

        return scan_windows(step, state, self.input_gates(self.input_features(x)), elapsed)
