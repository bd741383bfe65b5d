"""Zernike coefficients on a lattice: plane waves (phase.py) summed up by products of matrices.

A wave on a lattice is its rows times its columns.  This is the CPU's way, a view and some frames at
a time, the passes before and after the products compiled (engines/waves.py); whole_clip.py has a
device's.
"""

from functools import cached_property
from itertools import pairwise
from math import pi

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from src.sim.turbulence.engines import waves as compiled
from src.sim.turbulence.lattice import Lattice
from src.sim.turbulence.phase import Waves
from src.sim.turbulence.zernike import noll_index

FAINT = 1e-4, 3e-3  # of the variance of the modes of an order, tilt and the rest, left out
ROW = 8  # columns of a table are a multiple of it: products of matrices are faster then


class Field:
    """The Noll coefficients of `modes` (0 is x-tilt) on the nodes of two lattices, in rad.

    `size` is the frame's (height, width); the axis of the camera goes through its middle.  A wave
    on a lattice is its rows times its columns, so the sum over waves is a product of matrices, one
    for all modes of an order n, over the waves which that order sees; of the columns only half is
    computed, since what is even about the middle column and what is odd serve the other half too.
    """

    def __init__(
        self,
        waves: Waves,
        modes: slice,
        rows: Lattice,
        columns: Lattice,
        size: tuple[int, int],
    ):
        middle = (columns.pixels[0] + columns.pixels[-1]) / 2
        turned = torch.complex(*_turns(waves.frequency[:, 0], middle - (size[1] - 1) / 2))
        response = torch.view_as_complex(waves.response[modes]).to(torch.complex64)
        down = _turns(waves.frequency[:, 1], rows.pixels - (size[0] - 1) / 2)
        half = columns.pixels[len(columns.pixels) // 2 :] - middle
        across = [pad(t, (0, -t.shape[1] % ROW)) for t in _turns(waves.frequency[:, 0], half)]
        self.orders = []
        for own, seen in orders(response, modes.start or 0):
            turn = torch.view_as_real((response[own] * turned)[:, seen]).contiguous()
            rows_of = [part[seen].T.contiguous() for part in down]
            compiled_for = [part.numpy() for part in (turn, seen, *rows_of)]
            self.orders.append((own, *compiled_for, *(part[seen] for part in across)))
        self.shape = (len(response), len(rows.pixels), len(columns.pixels))
        self.rows, self.columns = rows, columns

    def at_nodes(
        self, amplitudes: Complex[Tensor, "frames waves"]
    ) -> Float[Tensor, "modes frames rows columns"]:
        """Return the coefficients on the nodes: Re sum_m c_m w_m Q_j exp(2 pi i f_m . x)."""
        modes, rows, columns = self.shape
        out = torch.empty(modes, len(amplitudes), rows, columns)
        drawn = torch.view_as_real(amplitudes).numpy()
        for own, response, seen, *down, cos, sin in self.orders:
            even, odd = compiled.spread(response, drawn, seen, *down)
            even, odd = torch.from_numpy(even) @ cos, torch.from_numpy(odd) @ sin
            compiled.join(even.numpy(), odd.numpy(), out[own].view(-1, columns).numpy())
        return out

    def at_pixels(
        self, amplitudes: Complex[Tensor, "frames waves"]
    ) -> Float[Tensor, "modes frames h w"]:
        """Return the coefficients on all pixels that the lattices serve."""
        field = self.at_nodes(amplitudes)
        if self.rows.pitch > 1:
            field = self._vertical @ field
        return field @ self._horizontal if self.columns.pitch > 1 else field

    @cached_property
    def _vertical(self) -> Float[Tensor, "h rows"]:
        return self.rows.weights()

    @cached_property
    def _horizontal(self) -> Float[Tensor, "columns w"]:
        return self.columns.weights().T


def orders(
    response: Complex[Tensor, "modes waves"], first: int
) -> list[tuple[slice, Int[Tensor, " some"]]]:
    """Return the modes of every order n as a slice, mode 0 of them being `first` (0 is x-tilt), and
    the waves which that order sees: those that make up its variance, all but FAINT of it.
    """
    order = [noll_index(mode + 2)[0] for mode in range(first, first + len(response))]
    edges = [i for i in range(len(order) + 1) if i in (0, len(order)) or order[i] != order[i - 1]]
    parts = [slice(*pair) for pair in pairwise(edges)]
    return [(own, _seen(response[own], FAINT[own.start + first > 1])) for own in parts]


def _seen(response: Complex[Tensor, "modes waves"], faint: float) -> Int[Tensor, " some"]:
    share = response.abs().square().sum(0)
    strength, order = share.sort()
    kept = order[strength.cumsum(0) > faint * strength.sum()]
    return kept.sort().values


def _turns(frequency: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """Return cos and sin of 2 pi f x, float32 (waves, *places), of every wave at every place.

    Whole turns are taken off in float64.
    """
    place = torch.as_tensor(place).double()
    turns = frequency.reshape(-1, *[1] * place.ndim) * place
    angle = (2 * pi * (turns - turns.round())).float()
    return angle.cos(), angle.sin()
