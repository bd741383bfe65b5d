"""Selective state spaces (Gu & Dao 2023, Mamba) in plain PyTorch, in both directions of a sequence.

    state <- exp(delta * A) * state + delta * B * x        read = C . state

per channel with its own few states; delta, B and C follow from the input.
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


def selective_scan(
    x: Tokens, delta: Tokens, a: Float[Tensor, "c s"], b: States, c: States
) -> Tokens:
    """Return what each channel reads; `a` < 0, `delta` > 0, so no decay exceeds one.

    Block after block, so that the memory of states is that of one block.
    """
    blocks = zip(*(part.split(BLOCK, 1) for part in (x, delta, b, c)), strict=True)
    state, read = x.new_zeros(len(x), *a.shape), []
    for x, delta, b, c in blocks:
        piece, state = _block(x, delta, a, b, c, state)
        read.append(piece)
    return torch.cat(read, 1)


def _block(
    x: Tensor, delta: Tensor, a: Tensor, b: Tensor, c: Tensor, state: Tensor
) -> tuple[Tensor, Tensor]:
    """Return `selective_scan` from `state` (n, c, s) on, and the last state.

    In two levels: pieces of about sqrt(length) run side by side from zero, then each piece gets
    what the ones before it left, decayed.  2 sqrt(length) steps in a row instead of `length`.
    """
    length = x.shape[1]
    piece = math.ceil(math.sqrt(length))
    missing = -length % piece
    if missing:  # delta 0 changes nothing
        padding = (0, 0, 0, missing)
        x, delta, b, c = (functional.pad(part, padding) for part in (x, delta, b, c))
    decay = torch.exp(delta[..., None] * a).unflatten(1, (-1, piece))
    drive = ((delta * x)[..., None] * b[:, :, None]).unflatten(1, (-1, piece))
    states, decays = _run(decay, drive, 2)
    lasts, fades = states[:, :, -1], decays[:, :, -1]
    first = lasts[:, :1] + fades[:, :1] * state[:, None]
    carried, _ = _run(fades, torch.cat([first, lasts[:, 1:]], 1), 1)
    before = torch.cat([state[:, None], carried[:, :-1]], 1)
    states = (states + decays * before[:, :, None]).flatten(1, 2)
    return torch.einsum("nlcs,nls->nlc", states, c)[:, :length], carried[:, -1]


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


class DirectionalScan(nn.Module):
    """One direction of a sequence: causal convolution, then the scan.

    `takes_guide`: delta, B and C follow from a guide instead of from the input.
    """

    def __init__(self, channels: int, states: int, rank: int, takes_guide: bool):
        super().__init__()
        self.rank, self.states = rank, states
        self.conv = nn.Conv1d(channels, channels, TAPS, padding=TAPS - 1, groups=channels)
        if takes_guide:
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
        delta, b, c = self.select(chooser).float().split(sizes, dim=-1)
        delta = functional.softplus(self.step(delta.to(x.dtype)).float())
        read = selective_scan(x.float(), delta, -self.log_rate.float().exp(), b, c)
        return (read + self.through * x).to(x.dtype)


class BidirectionalMamba(nn.Module):
    """A gated selective state space in both directions, with or without a guide."""

    def __init__(self, width: int, states: int = 16, takes_guide: bool = False):
        super().__init__()
        inner, rank = EXPAND * width, math.ceil(width / 16)
        self.enter = nn.Linear(width, inner if takes_guide else 2 * inner, bias=False)
        if takes_guide:
            self.enter_guide = nn.Linear(2 * width, 2 * inner, bias=False)
        self.ahead = DirectionalScan(inner, states, rank, takes_guide)
        self.back = DirectionalScan(inner, states, rank, takes_guide)
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
