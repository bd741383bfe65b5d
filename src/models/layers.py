"""Layers that recurrent reconstruction networks are made of; state in, state out."""

from collections.abc import Callable
from typing import Literal

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.nn import functional


def pad_centred_to_multiple(
    x: Float[Tensor, "n c h w"], multiple: int
) -> tuple[Float[Tensor, "n c hp wp"], tuple[int, int]]:
    """Return `x` padded by reflection, centred, to the next multiple in each axis, and how many
    rows and columns were added above and to the left.
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

    def __init__(self, channels: int, padding_mode: Literal["zeros", "reflect"] = "zeros"):
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
            nn.init.zeros_(require_bias(gate))

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
        return self.relu(x + self.conv2(self.relu(self.conv1(x))))


class PreActivationBlock(nn.Module):
    """Adds two 3 x 3 convolutions to a map, a ReLU before each (He et al. 2016); zero at first."""

    def __init__(self, channels: int):
        super().__init__()
        self.conv1 = init_kaiming(nn.Conv2d(channels, channels, 3, padding=1))
        self.conv2 = init_zero(nn.Conv2d(channels, channels, 3, padding=1))
        self.relu = nn.ReLU()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        return x + self.conv2(self.relu(self.conv1(self.relu(x))))


class EqualDCConv(nn.Conv2d):
    """A convolution whose outputs, the pixels of a cell, have the same response to a constant
    input: an area without detail gets no pattern of its pixels.
    """

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n pixels _h _w"]:
        return functional.conv2d(x, *self.equalised())

    def equalised(self) -> tuple[Tensor, Tensor]:
        """Return the kernels and the bias that are used."""
        response = self.weight.mean((2, 3), keepdim=True)  # to a constant input
        weight = self.weight - response + response.mean(0, keepdim=True)
        return weight, require_bias(self).mean().expand(len(weight))


def scan_windows(
    step: Callable[..., Tensor], state: Float[Tensor, "n ..."], *maps: Shaped[Tensor, "m ..."]
) -> tuple[Float[Tensor, "m ..."], Float[Tensor, "n ..."]]:
    """Return the state after every window and after the last: state = step(state, *maps of the
    window), with `maps` of m = windows * n.
    """
    if len(maps[0]) == len(state):  # OpenVINO would copy what is split into one
        state = step(state, *maps)
        return state, state
    states = []
    for now in zip(*(part.split(len(state)) for part in maps), strict=True):
        state = step(state, *now)
        states.append(state)
    return torch.cat(states), state


def require_bias(layer: nn.Conv2d | nn.Linear) -> Tensor:
    """Return the bias, which the layer must have."""
    assert layer.bias is not None
    return layer.bias


def init_kaiming(conv: nn.Conv2d) -> nn.Conv2d:
    """Return `conv` initialised to keep the scale of its input (He et al. 2015)."""
    nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
    nn.init.zeros_(require_bias(conv))
    return conv


def init_zero(conv: nn.Conv2d) -> nn.Conv2d:
    """Return `conv` with zeros."""
    nn.init.zeros_(conv.weight)
    nn.init.zeros_(require_bias(conv))
    return conv
