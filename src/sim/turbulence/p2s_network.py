"""From phase to the weights of a PSF basis: a network with the symmetries that a round pupil has.

Mirror the columns of the phase, or its rows, and the PSF is mirrored likewise; turn the phase by
half a turn and change its sign, and the PSF stays as it is.  So every Zernike mode and every
function of the basis is of one of four kinds: even (0), odd along x (1), odd along y (2) or odd
along both (3), a product of two kinds is of the kind 1 ^ 2 = 3 and so on, and the modes of kinds 0
and 3, whose n is even, can only come in pairs.  What is built here of linear forms of each kind and
their products cannot do otherwise: it need not learn the symmetry, and costs a third of a network
that knows none.
"""

import warnings
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from numpy import ndarray
from torch import Tensor, nn
from torch.nn import functional

from src.sim.turbulence.zernike import noll_index

EVEN, ACROSS, DOWN, BOTH = range(4)


def mode_kind(mode: int) -> int:
    """Return the kind of Noll mode `mode`."""
    m = noll_index(mode)[1]
    if m % 2 == 0:
        return EVEN if m >= 0 else BOTH
    return ACROSS if m > 0 else DOWN


def shape_kinds(basis: Float[Tensor, "rank fine fine"]) -> Int[Tensor, " rank"]:
    """Return the kind of each function, from its rows y and columns x."""
    down, across = ((basis * basis.flip(axis)).sum((1, 2)) < 0 for axis in (1, 2))
    return 2 * down.long() + across.long()


class Network(nn.Module):
    """Weights of the basis functions, by kind, from Noll 4..modes + 1.

    `width`: hidden numbers, a multiple of 16; `counts`: basis functions of each kind; `edge`: the
    D/r0 at which (D/r0 / edge)^(5/3), the phase variance that is usual, is 1.
    """

    def __init__(self, modes: int, width: int, counts: list[int], edge: float):
        super().__init__()
        kinds = [mode_kind(mode) for mode in range(4, modes + 2)]
        self.own = [[i for i, kind in enumerate(kinds) if kind == one] for one in range(4)]
        self.modes, self.width, self.counts, self.edge = modes, width, list(counts), edge
        few = 3 * width // 16
        wide = {EVEN: 2 * few, ACROSS: few, DOWN: few, BOTH: width // 4}
        self.forms = nn.ModuleList(self._form(kind, wide[kind]) for kind in range(4))
        self.common = _layer(sum(wide.values()) + 1, width)
        self.even = _layer(width, counts[EVEN])
        self.factors = nn.ModuleList(self._form(kind, few) for kind in range(4))
        self.pair_gates = _layer(width, 2 * few)
        self.both = _layer(2 * few, counts[BOTH], bias=False)
        self.pairs = _layer(2 * few, few, bias=False)
        self.thirds = nn.ModuleList(self._form(kind, few) for kind in (DOWN, ACROSS))
        self.gates = nn.ModuleList(_layer(width, few) for _ in range(2))
        odd = (_layer(2 * few, counts[kind], bias=False) for kind in (ACROSS, DOWN))
        self.odd = nn.ModuleList(odd)

    def _form(self, kind: int, count: int) -> nn.Linear:
        return _layer(len(self.own[kind]), count, bias=False)

    def forward(
        self, phase: Float[Tensor, "n blurmodes"], d_over_r0: float | Float[Tensor, "n 1"]
    ) -> Float[Tensor, "n rank"]:
        """Return the weights, sorted by kind, for Noll 4..modes + 1 in rad."""
        own = [phase[:, rows] for rows in self.own]
        forms = [form(part) for form, part in zip(self.forms, own, strict=True)]
        usual = phase.new_ones(len(phase), 1) * (d_over_r0 / self.edge) ** (5 / 3)
        squares = torch.cat([*(form.square() for form in forms), usual], 1)
        known = functional.hardswish(self.common(squares))
        a, b, c, d = (form(part) for form, part in zip(self.factors, own, strict=True))
        twos = torch.cat([a * d, b * c], 1) * self.pair_gates(known)
        mixed = self.pairs(twos)
        single = [
            torch.cat([forms[kind] * gate(known), mixed * third(own[other])], 1)
            for kind, other, gate, third in zip(
                (ACROSS, DOWN), (DOWN, ACROSS), self.gates, self.thirds, strict=True
            )
        ]
        odd = [layer(part) for layer, part in zip(self.odd, single, strict=True)]
        return torch.cat([self.even(known), *odd, self.both(twos)], 1)

    def see(self, spread: Float[Tensor, " blurmodes"]) -> None:
        """Begin with linear forms of phase in units of its `spread`, rad."""
        forms = [*self.forms, *self.factors, *self.thirds]
        kinds = [*range(4), *range(4), DOWN, ACROSS]
        for form, kind in zip(forms, kinds, strict=True):
            form.weight.data /= spread[self.own[kind]]

    def macs(self, rank: int | Tensor) -> float | Tensor:
        """Return the multiplications of one node, for about the first `rank` functions."""
        every = sum(layer.weight.numel() for layer in self.modules() if hasattr(layer, "weight"))
        last = [self.even, *self.odd, self.both]
        share = 1 - rank / sum(self.counts)
        return every - share * sum(layer.weight.numel() for layer in last)

    def cut(self, counts: list[int]) -> "Network":
        """Return the network of the first `counts` functions of each kind."""
        own = Network(self.modes, self.width, counts, self.edge).requires_grad_(False)
        shapes = {name: tuple(value.shape) for name, value in own.state_dict().items()}
        state = {name: value[: shapes[name][0]] for name, value in self.state_dict().items()}
        own.load_state_dict(state)
        return own

    def merged(self, given: int, d_over_r0: float) -> "Merged":
        """Return the same in few large matrices, for at most `given` modes from Noll 4 on; those
        that are not given count as zero.
        """
        few, width = len(self.gates[0].weight), self.width
        forms = [*enumerate(self.forms), *enumerate(self.factors[:2])]
        forms += [(BOTH, self.factors[BOTH]), (DOWN, self.factors[DOWN])]
        forms += [(DOWN, self.thirds[0]), (ACROSS, self.thirds[1])]
        first = [layer.weight.new_zeros(len(layer.weight), self.modes - 2) for _, layer in forms]
        for rows, (kind, layer) in zip(first, forms, strict=True):
            rows[:, self.own[kind]] = layer.weight
        usual = self.common.weight[:, -1] * (d_over_r0 / self.edge) ** (5 / 3) + self.common.bias
        gates = [self.pair_gates, *self.gates]
        last = self.even.weight.new_zeros(1 + sum(self.counts), width + 1 + 6 * few)
        last[0, width] = 1
        even, across, down, both = last[1:].split(self.counts)
        even[:, :width], even[:, width] = self.even.weight, self.even.bias
        both[:, width + 1 : width + 1 + 2 * few] = self.both.weight
        for kind, (rows, layer) in enumerate(zip((across, down), self.odd, strict=True)):
            for part, weight in enumerate(layer.weight.split(few, 1)):
                start = width + 1 + (2 + kind + 2 * part) * few
                rows[:, start : start + few] = weight
        return Merged(
            torch.cat(first)[:, :given].contiguous(),
            torch.cat([self.common.weight[:, :-1], usual[:, None]], 1),
            torch.cat([torch.cat([gate.weight, gate.bias[:, None]], 1) for gate in gates]),
            torch.cat([self.pairs.weight] * 2),
            last,
        )

    def matrices(self) -> tuple[ndarray, ...]:
        """Return all layers, each with its bias (or zeros) as a last column, for the CPU engine."""
        layers = [
            *self.forms, self.common, self.even, *self.factors, self.pair_gates, self.both,
            self.pairs, *self.thirds, *self.gates, *self.odd,
        ]  # fmt: skip
        return tuple(_matrix(layer) for layer in layers)


class Merged(NamedTuple):
    """A network of one D/r0 as the matrices that nodes meet in turn, each with its bias as the
    column of a constant 1.

    `first`: the linear forms that are squared, both factors of pairs and those of products of
    three; `common`, of squares; `gates`: of pairs and of products; `pairs`, twice; `last`: of
    common numbers, 1, pairs, gated forms and products of three.
    """

    first: Tensor
    common: Tensor
    gates: Tensor
    pairs: Tensor
    last: Tensor

    def __call__(
        self, phase: Float[Tensor, "blurmodes nodes"]
    ) -> Float[Tensor, "one_and_rank nodes"]:
        """Return 1, the weight of the mean, and the weights, sorted by kind, for Noll 4 and the
        modes after it in rad.
        """
        known, few = self.first.shape[1], len(self.pairs) // 2
        width, wide = len(self.common), self.common.shape[1] - 1
        first = self.first[:, : len(phase)] @ phase[:known]
        forms, left, right, thirds = first.split([wide, 2 * few, 2 * few, 2 * few])
        squares = phase.new_empty(wide + 1, phase.shape[1])
        torch.mul(forms, forms, out=squares[:wide])
        squares[wide] = 1
        parts = phase.new_empty(self.last.shape[1], phase.shape[1])
        common, twos, single, mixed = parts.split([width + 1, 2 * few, 2 * few, 2 * few])
        torch.mm(self.common, squares, out=common[:width])
        functional.hardswish(common[:width], inplace=True)
        common[width] = 1
        gates = self.gates @ common
        torch.mul(left, right, out=twos).mul_(gates[: 2 * few])
        torch.mul(forms[2 * few : 4 * few], gates[2 * few :], out=single)
        torch.mul(self.pairs @ twos, thirds, out=mixed)
        return self.last @ parts


def _layer(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Initializing zero-element tensors")  # no mode of a kind
        return nn.Linear(inputs, outputs, bias)


def _matrix(layer: nn.Linear) -> ndarray:
    bias = layer.weight.new_zeros(len(layer.weight)) if layer.bias is None else layer.bias
    return torch.cat([layer.weight, bias[:, None]], 1).detach().float().contiguous().numpy()
