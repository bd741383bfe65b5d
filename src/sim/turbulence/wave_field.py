"""Zernike coefficients on a lattice: plane waves (phase.py) summed up by products of matrices.

A wave on a lattice is its rows times its columns.  On the CPU the passes before and after the
products are compiled (engines/waves.py), elsewhere they are torch expressions.
"""

from collections.abc import Callable
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
        device: torch.device,
    ):
        middle = (columns.pixels[0] + columns.pixels[-1]) / 2
        turned = torch.complex(*_turns(waves.frequency[:, 0], middle - (size[1] - 1) / 2))
        response = torch.view_as_complex(waves.response[modes]).to(torch.complex64) * turned
        down = _turns(waves.frequency[:, 1], rows.pixels - (size[0] - 1) / 2)
        half = columns.pixels[len(columns.pixels) // 2 :] - middle
        across = [pad(t, (0, -t.shape[1] % ROW)) for t in _turns(waves.frequency[:, 0], half)]
        self.orders = []
        for own in _orders(modes.start or 0, len(response)):
            seen = _seen(response[own], FAINT[own.start + (modes.start or 0) > 1])
            tables = [part[seen].T.contiguous() for part in down] + [part[seen] for part in across]
            parts = [part.to(device) for part in (response[own][:, seen], *tables)]
            self.orders.append((own, seen, *parts))
        self.shape = (len(response), len(rows.pixels), len(columns.pixels))
        self.rows, self.columns, self.device = rows, columns, device

    def at_nodes(
        self, amplitudes: Complex[Tensor, "frames waves"], engine: Callable | None = None
    ) -> Float[Tensor, "modes frames rows columns"]:
        """Return the coefficients on the nodes: Re sum_m c_m w_m Q_j exp(2 pi i f_m . x).

        `engine`: `sums` or `sums_cpu`; None: the one for the device.
        """
        engine = engine or (sums_cpu if self.device.type == "cpu" else sums)
        modes, rows, columns = self.shape
        out = torch.empty(modes, len(amplitudes), rows, columns, device=self.device)
        for own, seen, response, *tables in self.orders:
            turn = (response[:, None] * amplitudes[:, seen]).flatten(0, 1)
            real, imag = turn.real.contiguous(), turn.imag.contiguous()
            engine(real, imag, *tables, out[own].view(-1, columns))
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
        return self.rows.weights().to(self.device)

    @cached_property
    def _horizontal(self) -> Float[Tensor, "columns w"]:
        return self.columns.weights().T.to(self.device)


def sums(
    real: Float[Tensor, "lines waves"],
    imag: Float[Tensor, "lines waves"],
    cos_down: Float[Tensor, "rows waves"],
    sin_down: Float[Tensor, "rows waves"],
    cos: Float[Tensor, "waves half"],
    sin: Float[Tensor, "waves half"],
    out: Float[Tensor, "lines*rows columns"],
) -> None:
    """Write the sums over waves of one order to `out`."""
    columns, real, imag = out.shape[1], real[:, None], imag[:, None]
    even = (real * cos_down).addcmul_(imag, sin_down, value=-1).flatten(0, 1) @ cos
    odd = (real * sin_down).addcmul_(imag, cos_down).flatten(0, 1) @ sin
    left, middle = columns // 2, columns % 2
    torch.sub(even[:, : left + middle], odd[:, : left + middle], out=out[:, left:])
    out[:, :left] = (even + odd)[:, middle : left + middle].flip(1)


def sums_cpu(real, imag, cos_down, sin_down, cos, sin, out) -> None:
    """Do the same in fewer passes."""
    down = (real, imag, cos_down, sin_down)
    even, odd = compiled.spread(*(part.numpy() for part in down))
    even, odd = torch.from_numpy(even) @ cos, torch.from_numpy(odd) @ sin
    compiled.join(even.numpy(), odd.numpy(), out.numpy())


def _orders(first: int, count: int) -> list[slice]:
    """Return the modes first .. first + count - 1 (0 is x-tilt) by order n, numbered from 0."""
    order = [noll_index(mode + 2)[0] for mode in range(first, first + count)]
    edges = [i for i in range(count + 1) if i in (0, count) or order[i] != order[i - 1]]
    return [slice(*pair) for pair in pairwise(edges)]


def _seen(response: Complex[Tensor, "modes waves"], faint: float) -> Int[Tensor, " some"]:
    """Return the waves that make up the modes' variance, all but `faint` of it."""
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
