"""From phase to space: a PSF basis per band of D/r0 and small networks from phase to its weights.

The idea is Mao, Chimitt & Chan 2021 (ICCV), "Accelerating atmospheric turbulence simulation via
learned phase-to-space transform".  Basis, networks (p2s_network.py) and error tables are our own,
fitted to exact Fraunhofer PSFs by `python -m scripts.fit_p2s` and kept in p2s.safetensors.  A
network sees the first modes only but is fitted to PSFs of all of them: what it gives is their mean
under the modes it knows, so the modes it does without blur as they do on average.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from src.sim.turbulence.engines import weights as weights_engine
from src.sim.turbulence.p2s_network import Merged, Network, shape_kinds
from src.sim.turbulence.psf import resampling

FILE = Path(__file__).with_suffix(".safetensors")
BEYOND = 1.06  # the networks are fitted a little beyond the edge of their band
FINE_PER_AIRY = 2.0  # samples of the basis per lambda / D: an intensity is band-limited to this


@dataclass(frozen=True)
class Band:
    """The basis and the networks for D/r0 up to `edge`.

    `mean` (fine, fine) and `basis` (rank, fine, fine) are PSFs sampled at FINE_PER_AIRY; the basis
    is ordered by its share in a natural picture, each function of one kind.  `networks`: from few
    modes to many.
    """

    edge: float
    mean: Float[Tensor, "fine fine"]
    basis: Float[Tensor, "rank fine fine"]
    networks: tuple[Network, ...]


@cache
def bands() -> tuple[Band, ...]:
    """Return the fitted bands, weakest first."""
    stored = load_file(FILE)
    return tuple(_band(stored, index) for index in range(len(stored["edges"])))


def _band(stored: dict[str, Tensor], index: int) -> Band:
    edge, basis = float(stored["edges"][index]), stored[f"{index}.basis"].float()
    counts = torch.bincount(shape_kinds(basis), minlength=4).tolist()
    networks = []
    for modes, width in stored["sizes"][index].tolist():
        network = Network(modes, width, counts, edge).requires_grad_(False)
        own = f"{index}.{len(networks)}."
        state = {name: stored[own + name].float() for name in network.state_dict()}
        network.load_state_dict(state)
        networks.append(network)
    return Band(edge, stored[f"{index}.mean"], basis, tuple(networks))


def band_for(strength: float) -> Band | None:
    """Return the weakest band that covers D/r0 = `strength`; None beyond the last."""
    return next((band for band in bands() if strength <= BEYOND * band.edge), None)


class Spots:
    """The PSFs of one atmosphere on the pixels of one camera, from the basis and a network.

    `rank` basis functions of `band`, integrated over pixels of lambda / D / `airy_px`, `size` of
    them across; the light that falls outside them is not in them.
    Weights are sorted by the symmetry of their functions, their kind; `ends` is where each ends.
    """

    def __init__(
        self, band: Band, network: int, rank: int, airy_px: float, size: int, d_over_r0: float
    ):
        grid = resampling(size, band.mean.shape[-1], FINE_PER_AIRY / airy_px).float()
        self.network, self.ends, shapes = _cut(band, network, rank)
        self.layers = _matrices(self.network)
        self.shapes = grid @ shapes @ grid.T
        quarter = self.shapes[:, size // 2 :, size // 2 :]
        self.quarter = quarter.permute(1, 2, 0).contiguous().numpy()
        self.d_over_r0 = d_over_r0
        self.own = tuple(np.array(rows, np.int64) for rows in self.network.own)

    def __call__(
        self, phase: Float[Tensor, "blurmodes frames rows columns"]
    ) -> Float[Tensor, "rank frames rows columns"]:
        """Return the weights at nodes for Noll 4, 5, ... in rad, on the CPU.

        Modes that are not given count as zero, those the network does not know by their mean.
        """
        known, given = self.network.modes - 2, phase.flatten(1)
        if len(given) < known:
            given = functional.pad(given, (0, 0, 0, known - len(given)))
        usual = np.float32((self.d_over_r0 / self.network.edge) ** (5 / 3))
        found = weights_engine.weights(given[:known].numpy(), self.own, usual, self.layers)
        return torch.from_numpy(found).unflatten(1, phase.shape[1:])

    def merged(self, modes: int) -> Merged:
        """Return the network as a device takes it, for at most `modes` modes from Noll 4 on."""
        return self.network.merged(modes, self.d_over_r0)


@cache
def _cut(band: Band, network: int, rank: int) -> tuple[Network, NDArray, Tensor]:
    """Return the network of the first `rank` functions, where each of their kinds ends, and mean
    and basis sorted by kind, over the light of the mean.
    """
    kind = shape_kinds(band.basis[:rank])
    counts = torch.bincount(kind, minlength=4)
    shapes = torch.cat([band.mean[None], band.basis[kind.argsort(stable=True)]])
    cut = band.networks[network].cut(counts.tolist())
    return cut, counts.cumsum(0).numpy(), shapes / band.mean.sum()


@cache
def _matrices(network: Network) -> tuple[NDArray, ...]:
    return network.matrices()
