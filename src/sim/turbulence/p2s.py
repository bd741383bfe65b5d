"""From phase to space: a PSF basis per band of D/r0 and small networks from phase to its weights.

The idea is Mao, Chimitt & Chan 2021 (ICCV), "Accelerating atmospheric turbulence simulation via
learned phase-to-space transform".  Basis, networks (p2s_network.py) and error tables are our own,
fitted to exact Fraunhofer PSFs by `python -m scripts.fit_p2s`.  A network sees the first modes only
but is fitted to PSFs of all of them: the modes it does without blur as they do on average.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch
from jaxtyping import Float
from safetensors.torch import load_file
from torch import Tensor

from src.sim.turbulence.p2s_network import PhaseToSpaceNetwork, basis_parities
from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D, pixel_integration_matrix

FILE = Path(__file__).with_suffix(".safetensors")
EDGE_MARGIN = 1.06  # the networks are fitted a little beyond the edge of their band


@dataclass(frozen=True)
class PSFBand:
    """The PSF basis and the networks for D/r0 up to `edge`.

    `mean` (fine, fine) and `basis` (rank, fine, fine) are PSFs sampled at
    SAMPLES_PER_LAMBDA_OVER_D; the basis is ordered by its share in a natural image, each function
    of one parity.  `networks`: from few modes to many.
    """

    edge: float
    mean: Float[Tensor, "fine fine"]
    basis: Float[Tensor, "rank fine fine"]
    networks: tuple[PhaseToSpaceNetwork, ...]


@cache
def load_psf_bands() -> tuple[PSFBand, ...]:
    """Return the fitted bands, weakest first."""
    stored, bands = load_file(FILE), []
    for index, edge in enumerate(stored["edges"].tolist()):
        networks = []
        for number, (modes, _) in enumerate(stored["sizes"][index].tolist()):
            prefix = f"{index}.{number}."
            names = [name.removeprefix(prefix) for name in stored if name.startswith(prefix)]
            layers = {name: stored[prefix + name].float() for name in names}
            networks.append(PhaseToSpaceNetwork(modes, edge, layers))
        mean, basis = stored[f"{index}.mean"], stored[f"{index}.basis"].float()
        bands.append(PSFBand(edge, mean, basis, tuple(networks)))
    return tuple(bands)


def find_psf_band(d_over_r0: float) -> PSFBand:
    """Return the weakest band that covers `d_over_r0`; raises ValueError beyond the last."""
    bands = load_psf_bands()
    if d_over_r0 > EDGE_MARGIN * bands[-1].edge:
        limit = EDGE_MARGIN * bands[-1].edge
        raise ValueError(f"turbulence: D/r0 of the blur must be <= {limit:g}, got {d_over_r0:g}")
    return next(band for band in bands if d_over_r0 <= EDGE_MARGIN * band.edge)


class FittedPSFs:
    """The PSFs of one atmosphere on the pixels of one camera, from the basis and a network.

    `rank` basis functions of `band`, integrated over `size` x `size` pixels of
    lambda / D / `lambda_over_d_px`; the light that falls outside them is not in them.
    `basis` (1 + rank, size, size): the mean, then the functions sorted by parity;
    `parity_ends`: where each of the four parities ends.
    """

    def __init__(
        self,
        band: PSFBand,
        network: int,
        rank: int,
        lambda_over_d_px: float,
        size: int,
        d_over_r0: float,
    ):
        step = SAMPLES_PER_LAMBDA_OVER_D / lambda_over_d_px
        grid = pixel_integration_matrix(size, band.mean.shape[-1], step).float()
        self.network, self.parity_ends, basis = _truncate(band, network, rank)
        self.basis, self.d_over_r0 = grid @ basis @ grid.T, d_over_r0
        quarter = self.basis[:, size // 2 :, size // 2 :]
        self.quarter = quarter.permute(1, 2, 0).contiguous().numpy()


@cache
def _truncate(
    band: PSFBand, network: int, rank: int
) -> tuple[PhaseToSpaceNetwork, tuple[int, ...], Tensor]:
    """Return the network of the first `rank` functions, where each of their parities ends, and mean
    and basis sorted by parity, over the light of the mean.
    """
    parity = basis_parities(band.basis[:rank])
    counts = torch.bincount(parity, minlength=4)
    basis = torch.cat([band.mean[None], band.basis[parity.argsort(stable=True)]])
    truncated = band.networks[network].truncate(counts.tolist())
    return truncated, tuple(counts.cumsum(0).tolist()), basis / band.mean.sum()
