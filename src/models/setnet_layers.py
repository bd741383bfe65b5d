"""What SetNet is made of: kernels for a set of views, a memory in continuous time, surroundings."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.autograd.function import FunctionCtx
from torch.nn import functional

PACE = 0.9  # what lies around fades by exp(-0.9) from one look to the next, before training


class ViewKernels(nn.Module):
    """The kernels of a convolution over a set of views, averaged; one follows from where it stands.

    kernel(place) = shared + sum over ranks of code(place) * kernels: with as many ranks as views
    it is an ordinary convolution of stacked views.
    """

    def __init__(self, inputs: int, outputs: int, kernel_size: int, ranks: int = 5):
        super().__init__()
        shape = ((ranks + 1) * outputs, inputs, kernel_size, kernel_size)
        bound = 1 / math.sqrt(inputs * kernel_size**2)
        self.kernels = nn.Parameter(torch.empty(shape).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.zeros(outputs))
        self.code = nn.Sequential(nn.Linear(3, 16), nn.Tanh(), nn.Linear(16, ranks))

    def kernel(
        self, places: Float[Tensor, "views 2"]
    ) -> Float[Tensor, "outputs viewsinputs size size"]:
        """Return the kernel for the stacked views that stand at `places` (row, col)."""
        code, parts = self.parts(places)
        return torch.einsum("vr,roikl->ovikl", code, parts).flatten(1, 2)

    def parts(
        self, places: Float[Tensor, "views 2"]
    ) -> tuple[Float[Tensor, "views parts"], Float[Tensor, "parts outputs inputs size size"]]:
        """Return how much of each part is in the kernel of each view, and the parts."""
        views = len(places)
        # Positions and the number of views, in units that keep the codes apart.
        known = torch.cat([places, torch.full_like(places[:, :1], 3 / views)], 1)
        code = self.code(known.to(self.bias.dtype))
        code = torch.cat([torch.ones_like(code[:, :1]), code], 1) / views
        return code, self.kernels.unflatten(0, (code.shape[1], -1))


class PacedUnit(nn.Module):
    """A gate beside a candidate in continuous time.

    Of the old state exp(-pace * relu(gate)) is left and the rest is the candidate's tanh: without
    pace, or with a gate below zero, nothing changes.  It stays within [-1, 1].  A place sees the
    state of its own only, so that nothing wanders.
    `rank`: gates and candidates are mixtures of so many maps of 3 x 3 (None: of as many as there
    are of both), which costs less.
    """

    def __init__(self, channels: int, rank: int | None = None):
        super().__init__()
        size = 1 if rank else 3
        self.mixed = nn.Conv2d(channels, rank, 3, padding=1, bias=False) if rank else nn.Identity()
        self.seen = nn.Conv2d(rank or channels, 2 * channels, size, padding=size // 2)
        self.kept = nn.Conv2d(channels, 2 * channels, 1, bias=False)
        with torch.no_grad():  # memories of one to twenty windows from the start
            self.seen.bias[:channels].copy_(torch.linspace(0.05, 0.7, channels))

    def forward(
        self,
        x: Float[Tensor, "m c h w"],
        state: Float[Tensor, "n c h w"],
        pace: Float[Tensor, "m 1 1 1"],
    ) -> tuple[Float[Tensor, "m c h w"], Float[Tensor, "n c h w"]]:
        """Return the state, float32, after every one of m = windows * n steps and after the last.

        `pace` is the time passed, in windows at 120 a second.
        """

        update = PacedUpdate.apply if torch.is_grad_enabled() else paced_update

        def step(state: Tensor, seen: Tensor, pace: Tensor) -> Tensor:
            return update(seen + self.kept(state.to(x.dtype)), state, pace)

        return over_time(step, state, self.seen(self.mixed(x)), pace)


def paced_update(
    both: Float[Tensor, "n c2 h w"], state: Float[Tensor, "n c h w"], pace: Float[Tensor, "n 1 1 1"]
) -> Float[Tensor, "n c h w"]:
    """Return the state after a step, float32; `both`: gates, then candidates, before their
    activations.
    """
    gate, candidate = both.float().chunk(2, 1)
    return torch.lerp(candidate.tanh(), state, torch.exp(-pace * gate.relu()))


class PacedUpdate(torch.autograd.Function):
    """`paced_update` with its gradient in half as many operators, in the layout of its input: with
    k = exp(-pace relu(g)) and c = tanh(a), s' = c + k (s - c) has ds = k ds', da = (1 - k) (1 -
    c^2) ds' and, where g > 0, dg = -pace k (s - c) ds'.
    """

    @staticmethod
    def forward(ctx: FunctionCtx, both: Tensor, state: Tensor, pace: Tensor) -> Tensor:
        """Return the state after a step; see `paced_update`."""
        gate, candidate = both.float().chunk(2, 1)
        keep, candidate = gate.relu().mul_(-pace).exp_(), candidate.tanh()
        ctx.save_for_backward(gate > 0, candidate, state, keep, pace)
        last = both.is_contiguous(memory_format=torch.channels_last)
        ctx.kind = both.dtype, torch.channels_last if last else torch.contiguous_format
        return torch.lerp(candidate, state, keep)

    @staticmethod
    def backward(ctx: FunctionCtx, slope: Tensor) -> tuple[Tensor, Tensor, None]:
        """Return the gradients of `both` and of the state."""
        opens, candidate, state, keep, pace = ctx.saved_tensors
        kind, layout = ctx.kind
        slope = slope.contiguous(memory_format=layout)  # or every operator here would turn it
        kept = slope * keep
        gates = (state - candidate).mul_(kept).mul_(-pace).mul_(opens)
        candidates = (slope - kept).mul_(1 - candidate.square())
        return torch.cat([gates, candidates], 1).to(kind, memory_format=layout), kept, None


class PartedUnit(nn.Module):
    """A PacedUnit for running one window: gate and candidate come from convolutions of their own,
    as to cut a map in two costs as much as a convolution, and the state is kept channels last, as
    convolutions take maps: to turn it costs as much.
    """

    def __init__(self, unit: PacedUnit):
        super().__init__()
        self.mixed = unit.mixed
        self.seen = nn.ParameterList(unit.seen.weight.chunk(2))
        self.bias = nn.ParameterList(unit.seen.bias.chunk(2))
        self.kept = nn.ParameterList(unit.kept.weight.chunk(2))

    def forward(
        self, x: Float[Tensor, "1 c h w"], state: Float[Tensor, "1 h w c"], pace: Tensor
    ) -> tuple[Float[Tensor, "1 c h w"], Float[Tensor, "1 h w c"]]:
        """Return the state after the window, channels first and as it is kept."""
        before = channels_first(state.to(x.dtype))
        mixed = self.mixed(x)
        gate, candidate = (
            functional.conv2d(mixed, seen, bias, padding=len(seen[0, 0]) // 2)
            + functional.conv2d(before, kept)
            for seen, bias, kept in zip(self.seen, self.bias, self.kept, strict=True)
        )
        keep = torch.exp(-pace * gate.relu().float())
        state = torch.lerp(candidate.tanh().float(), channels_first(state), keep)
        return state, channels_last(state)


def channels_first(x: Float[Tensor, "n h w c"]) -> Float[Tensor, "n c h w"]:
    """Return a view of `x`."""
    return x.permute(0, 3, 1, 2)


def channels_last(x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n h w c"]:
    """Return a view of `x`."""
    return x.permute(0, 2, 3, 1)


class Surroundings(nn.Module):
    """What lies around each place: a map is halved once for each of `widths`, the channels there,
    and what is seen so comes back, scale by scale.

    An area without events is known by its edges, which may be far.  No ReLU closes a path (He et
    al. 2016, identity mappings), and what comes back is nothing before training: otherwise a high
    rate shuts these layers for good (docs/decisions/0021).  What is remembered of it is a running
    mean, each channel's with a time constant of its own, learned.
    `refined`: a block of convolutions on the way back, too, where two scales have met.
    """

    def __init__(self, channels: int, widths: Sequence[int], refined: bool = False):
        super().__init__()
        pairs = list(pairwise([channels, *widths]))
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 3, 2, padding=1) for a, b in pairs)
        self.blocks = nn.ModuleList(Residual(width) for width in widths)
        self.ups = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        met = (Residual(width) if refined else nn.Identity() for width in widths[:-1])
        self.joined = nn.ModuleList(met)
        self.relu = nn.ReLU()
        for conv in (*self.downs, *self.ups):
            _healthy(conv)
        _silent(self.ups[0])
        self.pace = nn.Parameter(torch.full((channels, 1, 1), math.log(PACE)))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h2 w2"]:
        """Return a map of half the size."""
        scales = []
        for down, block in zip(self.downs, self.blocks, strict=True):
            x = block(down(x))
            scales.append(x)
        scales.pop()
        for up, joined in zip(reversed(self.ups[1:]), reversed(self.joined), strict=True):
            finer = scales.pop()
            x = joined(finer + _stretched(up(self.relu(x)), finer))
        return self.ups[0](self.relu(x))

    def mean(
        self,
        before: Float[Tensor, "n c h2 w2"],
        now: Float[Tensor, "n c h2 w2"],
        recent: Float[Tensor, "n 1 1 1"],
    ) -> Float[Tensor, "n c h2 w2"]:
        """Return the running mean with what is seen `now`; `recent`: how recent `before` is, 1 just
        now, 0 nothing yet.
        """
        return torch.lerp(now, before, recent ** self.pace.float().exp())


class Residual(nn.Module):
    """Adds to a map two 3x3 convolutions of it, a ReLU before each; nothing before training."""

    def __init__(self, channels: int):
        super().__init__()
        self.first = _healthy(nn.Conv2d(channels, channels, 3, padding=1))
        self.second = _silent(nn.Conv2d(channels, channels, 3, padding=1))
        self.relu = nn.ReLU()

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n c h w"]:
        """Return a map of the same shape."""
        return x + self.second(self.relu(self.first(self.relu(x))))


class Even(nn.Conv2d):
    """A convolution whose outputs, the pixels of a cell, are all the same where its input is
    everywhere the same: an area without detail gets no pattern of its pixels.
    """

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n pixels _h _w"]:
        """Return the maps of all pixels of a cell."""
        return functional.conv2d(x, *self.even())

    def even(self) -> tuple[Tensor, Tensor]:
        """Return the kernels and the bias of the pixels."""
        answers = self.weight.mean((2, 3), keepdim=True)  # to an input of the same everywhere
        weight = self.weight - answers + answers.mean(0, keepdim=True)
        return weight, self.bias.mean().expand(len(weight))


class FourCells(nn.Module):
    """An Even for running: gives the pixels of 2 x 2 cells at once, row by row, as so few outputs
    as those of one leave most of a processor's registers empty.
    """

    def __init__(self, conv: Even, side: int):
        super().__init__()
        kernels, bias = (part.detach() for part in conv.even())
        width = 2 * side  # of 2 x 2 cells, in pixels
        _, channels, size, _ = kernels.shape
        weight = kernels.new_zeros(width, width, channels, size + 1, size + 1)
        for row, column in np.ndindex(width, width):
            (down, a), (right, b) = divmod(row, side), divmod(column, side)
            kernel = kernels[side * a + b]
            weight[row, column, :, down : down + size, right : right + size] = kernel
        self.weight = nn.Parameter(weight.flatten(0, 1))
        self.bias = nn.Parameter(bias[0].repeat(width**2))

    def forward(self, x: Float[Tensor, "n c h w"]) -> Float[Tensor, "n pixels _h _w"]:
        """Return the maps of all pixels of 2 x 2 cells."""
        return functional.conv2d(x, self.weight, self.bias, 2)


def grown(x: Tensor, times: int) -> Tensor:
    """Return `x` with every pixel repeated."""
    return functional.interpolate(x, scale_factor=times, mode="nearest")


def over_time(
    step: Callable[..., Tensor], state: Float[Tensor, "n ..."], *maps: Shaped[Tensor, "m ..."]
) -> tuple[Float[Tensor, "m ..."], Float[Tensor, "n ..."]]:
    """Return the state after every window and after the last; `step` takes it and a window's part
    of each of `maps`, which have m = windows * n.
    """
    states = []
    for now in zip(*(part.split(len(state)) for part in maps), strict=True):
        state = step(state, *now)
        states.append(state)
    return torch.cat(states), state


def _stretched(x: Tensor, like: Tensor) -> Tensor:
    return functional.interpolate(x, like.shape[-2:], mode="bilinear")


def _healthy(conv: nn.Conv2d) -> nn.Conv2d:
    """Return `conv` with maps that are as large behind it as before (He et al. 2015)."""
    nn.init.kaiming_normal_(conv.weight, nonlinearity="relu")
    nn.init.zeros_(conv.bias)
    return conv


def _silent(conv: nn.Conv2d) -> nn.Conv2d:
    """Return `conv` with zeros."""
    nn.init.zeros_(conv.weight)
    nn.init.zeros_(conv.bias)
    return conv
