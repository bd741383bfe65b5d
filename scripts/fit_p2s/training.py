"""The network of src/sim/turbulence/p2s.py layer by layer, to be trained by fit_p2s.py."""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.sim.turbulence.p2s import EVEN, ODD_X, ODD_XY, ODD_Y, group_modes_by_symmetry


class TrainableNetwork(nn.Module):
    """Weights of the basis functions, by parity, from Noll 4..modes + 1.

    `width`: hidden numbers, a multiple of 16; `counts`: basis functions of each parity;
    `max_d_over_r0`: where (D/r0 / max_d_over_r0)^(5/3), the phase variance that is usual, is 1.
    """

    def __init__(self, modes: int, width: int, counts: list[int], max_d_over_r0: float):
        super().__init__()
        self.own = group_modes_by_symmetry(modes)
        self.modes, self.width, self.counts = modes, width, list(counts)
        self.max_d_over_r0 = max_d_over_r0
        few = 3 * width // 16
        wide = {EVEN: 2 * few, ODD_X: few, ODD_Y: few, ODD_XY: width // 4}
        self.forms = nn.ModuleList(self._form(parity, wide[parity]) for parity in range(4))
        self.common = _layer(sum(wide.values()) + 1, width)
        self.even = _layer(width, counts[EVEN])
        self.factors = nn.ModuleList(self._form(parity, few) for parity in range(4))
        self.pair_gates = _layer(width, 2 * few)
        self.both = _layer(2 * few, counts[ODD_XY], bias=False)
        self.pairs = _layer(2 * few, few, bias=False)
        self.thirds = nn.ModuleList(self._form(parity, few) for parity in (ODD_Y, ODD_X))
        self.gates = nn.ModuleList(_layer(width, few) for _ in range(2))
        odd = (_layer(2 * few, counts[parity], bias=False) for parity in (ODD_X, ODD_Y))
        self.odd = nn.ModuleList(odd)

    def _form(self, parity: int, count: int) -> nn.Linear:
        return _layer(len(self.own[parity]), count, bias=False)

    def forward(
        self, phase: Float[Tensor, "n blurmodes"], d_over_r0: float | Float[Tensor, "n 1"]
    ) -> Float[Tensor, "n rank"]:
        """Return the weights, sorted by parity, for Noll 4..modes + 1 in rad."""
        own = [phase[:, rows] for rows in self.own]
        forms = [form(part) for form, part in zip(self.forms, own, strict=True)]
        usual = phase.new_ones(len(phase), 1) * (d_over_r0 / self.max_d_over_r0) ** (5 / 3)
        squares = torch.cat([*(form.square() for form in forms), usual], 1)
        known = functional.hardswish(self.common(squares))
        a, b, c, d = (form(part) for form, part in zip(self.factors, own, strict=True))
        twos = torch.cat([a * d, b * c], 1) * self.pair_gates(known)
        mixed = self.pairs(twos)
        single = [
            torch.cat([forms[parity] * gate(known), mixed * third(own[other])], 1)
            for parity, other, gate, third in zip(
                (ODD_X, ODD_Y), (ODD_Y, ODD_X), self.gates, self.thirds, strict=True
            )
        ]
        odd = [layer(part) for layer, part in zip(self.odd, single, strict=True)]
        return torch.cat([self.even(known), *odd, self.both(twos)], 1)

    def scale_inputs(self, spread: Float[Tensor, " blurmodes"]) -> None:
        """Begin with linear forms of phase in units of its `spread`, rad."""
        forms = [*self.forms, *self.factors, *self.thirds]
        parities = [*range(4), *range(4), ODD_Y, ODD_X]
        for form, parity in zip(forms, parities, strict=True):
            form.weight.data /= spread[self.own[parity]]


def _layer(inputs: int, outputs: int, bias: bool = True) -> nn.Linear:
    with warnings.catch_warnings():
        warnings.filterwarnings(
            "ignore", "Initializing zero-element tensors"
        )  # no mode of a parity
        return nn.Linear(inputs, outputs, bias)
