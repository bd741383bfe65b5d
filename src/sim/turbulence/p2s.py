"""From phase to space: a PSF basis per band of D/r0 and small networks from phase to its weights.

The idea is Mao, Chimitt & Chan 2021 (ICCV), "Accelerating atmospheric turbulence simulation via
learned phase-to-space transform".  Basis, networks and error tables are our own, fitted to exact
Fraunhofer PSFs by `python -m scripts.fit_p2s` and kept in p2s.safetensors.  A network sees the
first modes only but is fitted to PSFs of all of them: what it gives is their mean under the modes
it knows, so the modes it does without blur as they do on average.
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
CHUNK = 2048  # nodes at a time, so that the hidden layers stay in the cache


@dataclass(frozen=True)
class Network:
    """Weights of the basis from Noll 4..modes + 1 in rad and the phase variance that is usual.

    `layers`: weight and bias of three linear layers; after the first every number is squared, as an
    intensity is of second order in the phase, after the second SiLU.  The last input is
    (D/r0 / edge)^(5/3), `edge` that of the band.
    """

    edge: float
    layers: tuple[tuple[Tensor, Tensor], ...]

    @property
    def modes(self) -> int:
        """Noll modes 2..modes + 1 are known to the network (it needs no tilt)."""
        return self.layers[0][0].shape[1] + 1

    def weights(
        self, coefficients: Float[Tensor, "blurmodes n"], d_over_r0: float, order: Tensor
    ) -> Float[Tensor, "rank n"]:
        """Return the weights of the basis functions `order` for Noll 4, 5, ... in rad.

        Modes that are not given count as zero, those it does not know by their mean.
        """
        (first, shift), *rest = ((w.to(coefficients), b.to(coefficients)) for w, b in self.layers)
        shift = shift + first[:, -1] * (d_over_r0 / self.edge) ** (5 / 3)
        count = min(len(coefficients), self.modes - 2)
        first, coefficients = first[:, :count].contiguous(), coefficients[:count]
        (second, middle), (last, end) = rest
        order = order.to(coefficients.device)
        last, end = last[order], end[order]
        out = coefficients.new_empty(len(last), coefficients.shape[1])
        for begin in range(0, out.shape[1], CHUNK):
            part = slice(begin, begin + CHUNK)
            x = torch.addmm(shift[:, None], first, coefficients[:, part])
            x = torch.addmm(middle[:, None], second, x.mul_(x))
            x = functional.silu(x, inplace=True)
            torch.addmm(end[:, None], last, x, out=out[:, part])
        return out


@dataclass(frozen=True)
class Band:
    """The basis and the networks for D/r0 up to `edge`.

    `mean` (fine, fine) and `basis` (rank, fine, fine) are PSFs sampled at FINE_PER_AIRY; the basis
    is ordered by its share in a natural picture, and each function is even or odd under the mirror
    of its rows and under that of its columns.  `networks`: from few modes to many.
    """

    edge: float
    mean: Float[Tensor, "fine fine"]
    basis: Float[Tensor, "rank fine fine"]
    networks: tuple[Network, ...]


@cache
def bands() -> tuple[Band, ...]:
    """Return the fitted bands, weakest first."""
    stored = load_file(FILE)
    return tuple(
        Band(
            edge=edge,
            mean=stored[f"{index}.mean"],
            basis=stored[f"{index}.basis"].float(),
            networks=tuple(
                _network(stored, f"{index}.{size}", edge) for size in range(stored["sizes"])
            ),
        )
        for index, edge in enumerate(stored["edges"].tolist())
    )


def _network(stored: dict[str, Tensor], name: str, edge: float) -> Network:
    layers = ((stored[f"{name}.{n}.weight"], stored[f"{name}.{n}.bias"]) for n in (0, 2, 4))
    return Network(edge, tuple((weight.float(), bias.float()) for weight, bias in layers))


class Spots:
    """The PSFs of one atmosphere on the pixels of one camera, from the basis and a network.

    `rank` basis functions of `band`, integrated over pixels of lambda / D / `airy_px`, `size` of
    them across; the light that falls outside them is not in them.
    Weights are sorted by the symmetry of their functions: even in rows and columns, odd in columns,
    odd in rows, odd in both; `ends` is where each kind ends.
    """

    def __init__(
        self, band: Band, network: int, rank: int, airy_px: float, size: int, d_over_r0: float
    ):
        grid = resampling(size, band.mean.shape[-1], FINE_PER_AIRY / airy_px).float()
        odd = [2 * _odd(shape, 0) + _odd(shape, 1) for shape in band.basis[:rank]]
        kind = torch.tensor(odd, dtype=torch.long)
        self.order = kind.argsort(stable=True)
        self.ends = torch.bincount(kind, minlength=4).cumsum(0).numpy()
        shapes = torch.cat([band.mean[None], band.basis[self.order]])
        self.shapes = grid @ (shapes / band.mean.sum()) @ grid.T
        quarter = self.shapes[:, size // 2 :, size // 2 :]
        self.quarter = quarter.permute(1, 2, 0).contiguous().numpy()
        self.network, self.d_over_r0 = band.networks[network], d_over_r0

    def __call__(
        self, phase: Float[Tensor, "blurmodes frames rows columns"]
    ) -> Float[Tensor, "rank frames rows columns"]:
        """Return the weights at nodes for Noll 4, 5, ... in rad."""
        weights = self.network.weights(phase.flatten(1), self.d_over_r0, self.order)
        return weights.unflatten(1, phase.shape[1:])

    def psfs(
        self, weights: Float[Tensor, "rank frames rows columns"]
    ) -> Float[Tensor, "pixels frames rows columns"]:
        """Return the PSFs of the weights, pixel by pixel; none is negative."""
        mean, basis = self.shapes[0].flatten(), self.shapes[1:].flatten(1)
        flat = torch.addmm(mean[:, None].to(weights), basis.T.to(weights), weights.flatten(1))
        return flat.clamp_(min=0).unflatten(1, weights.shape[1:])


def _odd(shape: Float[Tensor, "fine fine"], axis: int) -> bool:
    return bool((shape * shape.flip(axis)).sum() < 0)
