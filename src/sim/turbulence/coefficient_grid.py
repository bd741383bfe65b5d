"""Regular grids over an endless image, interpolation between their nodes, and sums of waves there.

A grid holds every `pitch`-th pixel, pixel 0 being the first of the frame, so that a crop uses the
same nodes as the frame.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from src.sim.turbulence.engines.waves_numba import join_even_odd, split_even_odd
from src.sim.turbulence.zernike import noll_index

# Of the variance of the modes of a radial order, tilt and the rest, that is left out with the
# weakest waves.
OMITTED_VARIANCE = 1e-4, 3e-3
PADDED_COLUMNS = 8  # products of matrices with a multiple of it are faster
Response = Complex[Tensor, "modes waves"]
WaveRows = Complex[Tensor, "waves rows"]
WaveColumns = Complex[Tensor, "waves columns"]
GridWaves = Float[Tensor, "twice_the_waves rows columns"]


@dataclass(frozen=True)
class GridAxis:
    """The nodes along one axis that pixels start .. start + count - 1 need.

    `interpolation_order` 1 is linear between two nodes, 3 Lagrange's cubic through four.
    """

    start: int
    count: int
    pitch: int
    interpolation_order: int

    @property
    def first_node(self) -> int:
        """The number of the first node; it lies on pixel first_node * pitch."""
        return self.start // self.pitch - (self.interpolation_order == 3 and self.pitch > 1)

    @property
    def node_count(self) -> int:
        if self.pitch == 1:
            return self.count
        beyond = 2 if self.interpolation_order == 3 else 1
        return (self.start + self.count - 1) // self.pitch + beyond + 1 - self.first_node

    @property
    def node_pixels(self) -> Int[Tensor, " nodes"]:
        return (torch.arange(self.node_count) + self.first_node) * self.pitch

    @property
    def offset_from_first_node_px(self) -> int:
        """How many pixels the first pixel lies after the first node."""
        return self.start - self.first_node * self.pitch

    def interpolation_matrix(self) -> Float[Tensor, "count nodes"]:
        """Return the weight of every node in every pixel; rows sum to 1."""
        if self.pitch == 1:
            return torch.eye(self.count, dtype=torch.float32)
        pixel = torch.arange(self.count) + self.offset_from_first_node_px
        cell = torch.div(pixel, self.pitch, rounding_mode="floor")
        t = (pixel - cell * self.pitch).double() / self.pitch
        near, taps = torch.arange(2), [1 - t, t]
        if self.interpolation_order == 3:  # Lagrange's weights of the nodes -1, 0, 1, 2
            near, below, above = torch.arange(-1, 3), t + 1, t - 2
            taps = [-t * (t - 1) * above / 6, below * (t - 1) * above / 2]
            taps += [-below * t * above / 2, below * t * (t - 1) / 6]
        weights = torch.zeros(self.count, self.node_count, dtype=torch.float64)
        return weights.scatter_(1, cell[:, None] + near, torch.stack(taps, dim=-1)).float()


Grid = tuple[GridAxis, GridAxis]  # rows and columns


def zero_weak_responses(response: Response, first_mode: int) -> Response:
    """Return `response` with 0 for waves that hardly count for a radial order (OMITTED_VARIANCE).

    Row 0 is mode `first_mode`, 0 being x-tilt.
    """
    strongest = torch.zeros_like(response)
    for rows in slices_by_radial_order(first_mode, len(response)):
        power, rank = response[rows].abs().square().sum(0).sort()
        waves = rank[power.cumsum(0) > OMITTED_VARIANCE[first_mode > 1] * power.sum()]
        strongest[rows, waves] = response[rows, waves]
    return strongest


def slices_by_radial_order(first_mode: int, modes: int) -> list[slice]:
    """Return the modes of each radial order n, as slices; mode 0 of them is `first_mode`."""
    order = [noll_index(mode + 2)[0] for mode in range(first_mode, first_mode + modes)]
    edges = [i for i in range(modes + 1) if i in (0, modes) or order[i] != order[i - 1]]
    return [slice(*pair) for pair in pairwise(edges)]


class WaveSum:
    """Sums of plane waves at the nodes of a grid on the CPU, by products of matrices.

    A wave on a grid is its rows times its columns.  There is a product for all modes of a radial
    order, over the waves that it sees, for what is even about the middle column and for what is
    odd.  `response`: that of `zero_weak_responses`, row 0 being mode `first_mode`; `rows`,
    `columns`: exp(-2 pi i f x) from the middle of the grid on.
    """

    def __init__(self, response: Response, rows: WaveRows, columns: WaveColumns, first_mode: int):
        half = columns[:, columns.shape[1] // 2 :]
        half = pad(half, (0, -half.shape[1] % PADDED_COLUMNS))
        self.radial_orders: list[tuple[slice, list[np.ndarray], Tensor, Tensor]] = []
        for modes in slices_by_radial_order(first_mode, len(response)):
            waves = (response[modes] != 0).any(0).nonzero()[:, 0]
            weights = torch.view_as_real(response[modes, waves].contiguous()).numpy()
            down = [part[waves].T.contiguous().numpy() for part in (rows.real, -rows.imag)]
            across = half.real[waves], -half.imag[waves]
            self.radial_orders.append((modes, [weights, waves.numpy(), *down], *across))
        self.shape = len(response), rows.shape[1], columns.shape[1]

    def __call__(
        self, amplitudes: Complex[Tensor, "frames waves"]
    ) -> Float[Tensor, "modes frames rows columns"]:
        """Return Re sum_m amplitude_m response_m exp(2 pi i f_m . x) at the nodes."""
        modes, rows, columns = self.shape
        out = torch.empty(modes, len(amplitudes), rows, columns, dtype=torch.float32)
        drawn = torch.view_as_real(amplitudes.contiguous()).numpy()
        for order, (weights, waves, cos_y, sin_y), cos_x, sin_x in self.radial_orders:
            even, odd = split_even_odd(weights, drawn, waves, cos_y, sin_y)
            even, odd = torch.from_numpy(even) @ cos_x, torch.from_numpy(odd) @ sin_x
            join_even_odd(even.numpy(), odd.numpy(), out[order].view(-1, columns).numpy())
        return out


def evaluate_waves(rows: WaveRows, columns: WaveColumns) -> GridWaves:
    """Return the real and the negative imaginary part of waves at all nodes; see WaveSum."""
    waves = torch.view_as_real(rows[:, :, None] * columns[:, None])
    return waves.permute(0, 3, 1, 2).flatten(0, 1)


def sum_waves(
    response: Response, amplitudes: Complex[Tensor, "n waves"], waves: GridWaves
) -> Float[Tensor, "modes n rows columns"]:
    """Return the same as WaveSum in one product of matrices, for a device."""
    parts = torch.view_as_real(response[:, None] * amplitudes).flatten(2).flatten(0, 1)
    found = parts @ waves.flatten(1)
    return found.view(len(response), len(amplitudes), *waves.shape[1:])
