"""From phase to space: a PSF basis per band of D/r0 and a small network from phase to its weights.

The idea is Mao, Chimitt & Chan 2021 (ICCV), "Accelerating atmospheric turbulence simulation via
learned phase-to-space transform"; basis, networks and error tables are our own, fitted to exact
Fraunhofer PSFs by `python -m scripts.fit_p2s` and kept in p2s.safetensors.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from src.sim.turbulence.psf import resampling

FILE = Path(__file__).with_suffix(".safetensors")
FINE_PER_AIRY = 2.0  # samples of the basis per lambda / D: an intensity is band-limited to this


@dataclass(frozen=True)
class Band:
    """The basis and the network for D/r0 up to `edge`.

    `mean` (fine, fine) and `basis` (rank, fine, fine) are PSFs sampled at FINE_PER_AIRY; the basis
    is ordered by its share in a natural picture.  `layers`: weight and bias of each linear layer,
    from Noll 4..modes + 1 in rad to the weights of the basis, SiLU in between.
    """

    edge: float
    mean: Float[Tensor, "fine fine"]
    basis: Float[Tensor, "rank fine fine"]
    layers: tuple[tuple[Tensor, Tensor], ...]

    @property
    def modes(self) -> int:
        """Noll modes 2..modes + 1 are known to the network (it needs no tilt)."""
        return self.layers[0][0].shape[1] + 2

    def weights(
        self, coefficients: Float[Tensor, "n blurmodes"], rank: int
    ) -> Float[Tensor, "n rank"]:
        """Return the weights of the first `rank` basis functions for Noll 4, 5, ... in rad.

        Modes that are not given count as zero.
        """
        *hidden, (weight, bias) = self.layers
        x = coefficients
        for index, (matrix, shift) in enumerate(hidden):
            matrix = matrix[:, : x.shape[1]] if index == 0 else matrix
            x = functional.silu(functional.linear(x, matrix.to(x), shift.to(x)))
        return functional.linear(x, weight[:rank].to(x), bias[:rank].to(x))


@cache
def bands() -> tuple[Band, ...]:
    """Return the fitted bands, weakest first."""
    stored = load_file(FILE)
    return tuple(
        Band(
            edge=float(edge),
            mean=stored[f"{index}.mean"],
            basis=stored[f"{index}.basis"].float(),
            layers=tuple(
                (stored[f"{index}.{layer}.weight"], stored[f"{index}.{layer}.bias"])
                for layer in (0, 2, 4)
            ),
        )
        for index, edge in enumerate(stored["edges"].tolist())
    )


class Spots:
    """The PSFs of one atmosphere on the pixels of one camera, from the basis and the network.

    `rank` basis functions of `band`, integrated over pixels of lambda / D / `airy_px`, `size` of
    them across; the light that falls outside them is not in them.
    """

    def __init__(self, band: Band, rank: int, airy_px: float, size: int):
        grid = resampling(size, band.mean.shape[-1], FINE_PER_AIRY / airy_px).float()
        shapes = torch.cat([band.mean[None], band.basis[:rank]])
        self.band, self.rank, self.size = band, rank, size
        self.shapes = (grid @ (shapes / band.mean.sum()) @ grid.T).flatten(1)

    def __call__(
        self, phase: Float[Tensor, "frames blurmodes rows columns"]
    ) -> Float[Tensor, "frames rows size size columns"]:
        """Return the PSFs at nodes for Noll 4, 5, ... in rad; none is negative."""
        frames, modes, rows, columns = phase.shape
        flat = phase.permute(0, 2, 3, 1).reshape(frames * rows * columns, modes)
        weights = self.band.weights(flat, self.rank)
        weights = weights.reshape(frames * rows, columns, self.rank).transpose(1, 2)
        mean, basis = self.shapes[:1].to(flat), self.shapes[1:].to(flat)
        spots = torch.matmul(basis.T, weights).add_(mean.T).clamp_(min=0)
        return spots.reshape(frames, rows, self.size, self.size, columns)
