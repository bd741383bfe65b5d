"""Layers that recurrent reconstruction networks are made of; state in, state out."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional


def pad_to_multiple(
    x: Float[Tensor, "n c h w"], multiple: int
) -> tuple[Float[Tensor, "n c hp wp"], tuple[int, int]]:
    """Pad by reflection, centred, to the next multiple in each axis.

    Returns the padded tensor and how many rows and columns were added above and to the left.
    """
    height, width = x.shape[-2:]
    rows, columns = -height % multiple, -width % multiple
    if rows == 0 and columns == 0:
        return x, (0, 0)
    top, left = rows // 2, columns // 2
    padding = (left, columns - left, top, rows - top)
    return functional.pad(x, padding, mode="reflect"), (top, left)


class ConvLSTM(nn.Module):
    """A convolutional LSTM cell (Shi et al. 2015) whose gates are one 3x3 convolution.

    Gate order along the channels: input, forget, output, candidate.
    """

    def __init__(self, channels: int, padding_mode: str = "zeros"):
        super().__init__()
        self.gates = nn.Conv2d(2 * channels, 4 * channels, 3, padding=1, padding_mode=padding_mode)

    def forward(
        self, x: Float[Tensor, "n c h w"], state: tuple[Tensor, Tensor] | None
    ) -> tuple[Float[Tensor, "n c h w"], tuple[Tensor, Tensor]]:
        """Return the hidden map and the new state (hidden, cell); None starts from zeros."""
        hidden, cell = (torch.zeros_like(x), torch.zeros_like(x)) if state is None else state
        i, f, o, c = self.gates(torch.cat([x, hidden], dim=1)).chunk(4, dim=1)
        cell = f.sigmoid() * cell + i.sigmoid() * c.tanh()
        hidden = o.sigmoid() * cell.tanh()
        return hidden, (hidden, cell)


class ConvGRU(nn.Module):
    """A convolutional GRU cell (Ballas et al. 2016): reset, update and candidate, each 3x3.

    The new state is a convex mix of the old one and a tanh, so it stays within [-1, 1].
    """

    def __init__(self, channels: int):
        super().__init__()
        self.reset_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.update_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        self.out_gate = nn.Conv2d(2 * channels, channels, 3, padding=1)
        for gate in (self.reset_gate, self.update_gate, self.out_gate):
            nn.init.orthogonal_(gate.weight)
            nn.init.zeros_(gate.bias)

    def forward(
        self, x: Float[Tensor, "n c h w"], state: Tensor | None
    ) -> tuple[Float[Tensor, "n c h w"], Tensor]:
        """Return the hidden map twice: as output and as new state; None starts from zeros."""
        state = torch.zeros_like(x) if state is None else state
        both = torch.cat([x, state], dim=1)
        update, reset = self.update_gate(both).sigmoid(), self.reset_gate(both).sigmoid()
        candidate = self.out_gate(torch.cat([x, state * reset], dim=1)).tanh()
        state = state * (1 - update) + candidate * update
        return state, state


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a ReLU inside and after the sum (He et al. 2016, no norm)."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, channels, 3, padding=1)
        self.conv2 = nn.Conv2d(channels, channels, 3, padding=1)
        self.relu = nn.ReLU()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return a map of the same shape."""
        return self.relu(x + self.conv2(self.relu(self.conv1(x))))
