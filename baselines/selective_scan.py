"""Selective state spaces (Gu & Dao 2023, Mamba) in plain PyTorch, in both directions of a sequence.

    state <- exp(step * rate) * state + step * enter * x        read = leave . state

per channel with its own few states; step, enter and leave follow from the input.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

TAPS = 4  # of the causal convolution before the scan
EXPAND = 2
Tokens = Float[Tensor, "n length c"]
States = Float[Tensor, "n length s"]
BLOCK = 16384  # positions whose states are kept at once: 64 MiB at 128 channels of 8 states


def scan(
    x: Tokens, step: Tokens, rate: Float[Tensor, "c s"], enter: States, leave: States
) -> Tokens:
    """Return what each channel reads; `rate` < 0, `step` > 0, so no decay exceeds one.

    Block after block, so that the memory of states is that of one block.
    """
    blocks = zip(*(part.split(BLOCK, 1) for part in (x, step, enter, leave)), strict=True)
    state, read = x.new_zeros(len(x), *rate.shape), []
    for x, step, enter, leave in blocks:
        piece, state = _block(x, step, rate, enter, leave, state)
        read.append(piece)
    return torch.cat(read, 1)


def _block(
    x: Tensor, step: Tensor, rate: Tensor, enter: Tensor, leave: Tensor, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Return `scan` from `state` (n, c, s) on, and the last state.

    In two levels: pieces of about sqrt(length) run side by side from zero, then each piece gets
    what the ones before it left, decayed.  2 sqrt(length) steps in a row instead of `length`.
    """
    length = x.shape[1]
    piece = math.ceil(math.sqrt(length))
    missing = -length % piece
    if missing:  # step 0 changes nothing
        padding = (0, 0, 0, missing)
        x, step, enter, leave = (functional.pad(a, padding) for a in (x, step, enter, leave))
    decay = torch.exp(step[..., None] * rate).unflatten(1, (-1, piece))
    drive = ((step * x)[..., None] * enter[:, :, None]).unflatten(1, (-1, piece))
    states, decays = _run(decay, drive, 2)
    lasts, fades = states[:, :, -1], decays[:, :, -1]
    first = lasts[:, :1] + fades[:, :1] * state[:, None]
    carried, _ = _run(fades, torch.cat([first, lasts[:, 1:]], 1), 1)
    before = torch.cat([state[:, None], carried[:, :-1]], 1)
    states = (states + decays * before[:, :, None]).flatten(1, 2)
    return torch.einsum("nlcs,nls->nlc", states, leave)[:, :length], carried[:, -1]


def _run(decay: Tensor, drive: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return states and products of decays along `axis`, one step after the other, from zero."""
    decays, drives = decay.unbind(axis), drive.unbind(axis)
    state, product = drives[0], decays[0]
    states, products = [state], [product]
    for factor, new in zip(decays[1:], drives[1:], strict=True):
        state, product = torch.addcmul(new, factor, state), factor * product
        states.append(state)
        products.append(product)
    return torch.stack(states, axis), torch.stack(products, axis)


class Direction(nn.Module):
    """One direction of a sequence: causal convolution, then the scan.

    `guided`: step, enter and leave follow from a guide instead of from the input.
    """

    def __init__(self, channels: int, states: int, rank: int, guided: bool):
        super().__init__()
        self.rank, self.states = rank, states
        self.conv = nn.Conv1d(channels, channels, TAPS, padding=TAPS - 1, groups=channels)
        if guided:
            self.guide_conv = nn.Conv1d(channels, channels, TAPS, padding=TAPS - 1, groups=channels)
        self.select = nn.Linear(channels, rank + 2 * states, bias=False)
        self.step = nn.Linear(rank, channels)
        self.log_rate = nn.Parameter(torch.arange(1.0, states + 1).log().repeat(channels, 1))
        self.through = nn.Parameter(torch.ones(channels))
        # Steps from 0.001 to 0.1, evenly in their logarithm, after the softplus.
        steps = torch.exp(torch.linspace(math.log(1e-3), math.log(0.1), channels))
        with torch.no_grad():
            self.step.bias.copy_(steps + torch.log(-torch.expm1(-steps)))
        nn.init.uniform_(self.step.weight, -(rank**-0.5), rank**-0.5)

    def forward(self, x: Tokens, guide: Tokens | None) -> Tokens:
        """Return what position i makes of positions 0 .. i."""
        x = _causal(self.conv, x)
        chooser = x if guide is None else _causal(self.guide_conv, guide)
        sizes = [self.rank, self.states, self.states]
        step, enter, leave = self.select(chooser).float().split(sizes, dim=-1)
        step = functional.softplus(self.step(step.to(x.dtype)).float())
        read = scan(x.float(), step, -self.log_rate.float().exp(), enter, leave)
        return (read + self.through * x).to(x.dtype)


class Mixer(nn.Module):
    """A gated selective state space in both directions, with or without a guide."""

    def __init__(self, width: int, states: int = 16, guided: bool = False):
        super().__init__()
        inner, rank = EXPAND * width, math.ceil(width / 16)
        self.enter = nn.Linear(width, inner if guided else 2 * inner, bias=False)
        if guided:
            self.enter_guide = nn.Linear(2 * width, 2 * inner, bias=False)
        self.ahead = Direction(inner, states, rank, guided)
        self.back = Direction(inner, states, rank, guided)
        self.leave = nn.Linear(inner, width, bias=False)

    def forward(self, x: Tokens, guide: Tokens | None = None) -> Tokens:
        if guide is None:
            x, gate = self.enter(x).chunk(2, dim=-1)
        else:
            guide, gate = self.enter_guide(torch.cat([x, guide], -1)).chunk(2, dim=-1)
            x = self.enter(x)
        turned = None if guide is None else guide.flip(1)
        both = self.ahead(x, guide) + self.back(x.flip(1), turned).flip(1)
        return self.leave(both * functional.silu(gate))


def _causal(conv: nn.Conv1d, x: Tensor) -> Tensor:
    length = x.shape[1]
    return functional.silu(conv(x.transpose(1, 2))[..., :length]).transpose(1, 2)
