"""From phase to space: a PSF basis per band of D/r0 and small networks from phase to its weights.

The idea is Mao, Chimitt & Chan 2021 (ICCV), "Accelerating atmospheric turbulence simulation via
learned phase-to-space transform".  Basis, networks and error tables are our own, fitted to
exact Fraunhofer PSFs by `python -m scripts.fit_p2s`.  A network sees the first modes only but is
fitted to PSFs of all of them: the modes it does without blur as they do on average.

Mirror the columns of the phase, or its rows, and the PSF is mirrored likewise; turn the phase by
half a turn and change its sign, and the PSF stays as it is.  So every Zernike mode and every
function of the basis is of one of four parities: even (0), odd along x (1), odd along y (2) or odd
along both (3); products have the parity 1 ^ 2 = 3 and so on, and modes of parities 0 and 3, whose n
is even, can only come in pairs.  Linear forms of each parity and their products have this symmetry
by construction.  scripts/fit_p2s/training.py has the layers one by one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from safetensors.torch import load_file
from torch import Tensor
from torch.nn import functional

from src.sim.turbulence.psf import SAMPLES_PER_LAMBDA_OVER_D, pixel_integration_matrix
from src.sim.turbulence.unresolved_blur import StructureFunction, blur_by_phase
from src.sim.turbulence.zernike import noll_index

FILE = Path(__file__).with_suffix(".safetensors")
EDGE_MARGIN = 1.06  # the networks are fitted a little beyond the edge of their band
EVEN, ODD_X, ODD_Y, ODD_XY = range(4)
OUTPUT_LAYERS = "even", "odd.0", "odd.1", "both"  # of the parities in turn


def mirror_symmetry_class(mode: int) -> int:
    """Return the parity of Noll mode `mode`."""
    m = noll_index(mode)[1]
    if m % 2 == 0:
        return EVEN if m >= 0 else ODD_XY
    return ODD_X if m > 0 else ODD_Y


def group_modes_by_symmetry(modes: int) -> list[list[int]]:
    """Return which of Noll 4..modes + 1, counted from 0, are of each parity."""
    parities = [mirror_symmetry_class(mode) for mode in range(4, modes + 2)]
    return [[i for i, parity in enumerate(parities) if parity == one] for one in range(4)]


def basis_parities(basis: Float[Tensor, "rank fine fine"]) -> Int[Tensor, " rank"]:
    """Return the parity of each function, from its rows y and columns x."""
    down, across = ((basis * basis.flip(axis)).sum((1, 2)) < 0 for axis in (1, 2))
    return 2 * down.long() + across.long()


@dataclass(frozen=True, eq=False)
class PhaseToSpaceNetwork:
    """The layers, by name, from Noll 4..modes + 1 to the weights of the basis functions.

    `max_d_over_r0`: where (D/r0 / max_d_over_r0)^(5/3), the phase variance that is usual, is 1.
    """

    modes: int
    max_d_over_r0: float
    layers: Mapping[str, Tensor]

    def count_macs(self, rank: int | Tensor) -> float | Tensor:
        """Return the multiplications of one node, for about the first `rank` functions."""
        last = [self.layers[f"{name}.weight"] for name in OUTPUT_LAYERS]
        every = sum(part.numel() for name, part in self.layers.items() if name.endswith("weight"))
        share = 1 - rank / sum(map(len, last))
        return every - share * sum(weight.numel() for weight in last)

    def truncate(self, counts: list[int]) -> "PhaseToSpaceNetwork":
        """Return the network of the first `counts` functions of each parity."""
        kept = dict(zip(OUTPUT_LAYERS, counts, strict=True))
        layers = {
            name: rows[: kept.get(name.rpartition(".")[0])] for name, rows in self.layers.items()
        }
        return replace(self, layers=layers)

    def merge_into_few_matrices(self, input_modes: int, d_over_r0: float) -> "FoldedNetwork":
        """Return few large matrices that do the same; modes from `input_modes` on are zero."""
        weight = {name.removesuffix(".weight"): part for name, part in self.layers.items()}
        few, width = weight["pairs"].shape[0], weight["common"].shape[0]
        forms = [(parity, weight[f"forms.{parity}"]) for parity in range(4)]
        forms += [(parity, weight[f"factors.{parity}"]) for parity in (EVEN, ODD_X, ODD_XY, ODD_Y)]
        forms += [(ODD_Y, weight["thirds.0"]), (ODD_X, weight["thirds.1"])]
        own = group_modes_by_symmetry(self.modes)
        first = [part.new_zeros(len(part), self.modes - 2) for _, part in forms]
        for rows, (parity, part) in zip(first, forms, strict=True):
            rows[:, own[parity]] = part
        usual = (d_over_r0 / self.max_d_over_r0) ** (5 / 3)
        constant = weight["common"][:, -1] * usual + weight["common.bias"]
        parts = [weight[name] for name in OUTPUT_LAYERS]
        last = constant.new_zeros(1 + sum(map(len, parts)), width + 1 + 6 * few)
        last[0, width] = 1
        even, across, down, both = last[1:].split([len(part) for part in parts])
        even[:, :width], even[:, width] = weight["even"], weight["even.bias"]
        both[:, width + 1 : width + 1 + 2 * few] = weight["both"]
        for parity, rows in enumerate((across, down)):
            for half, odd in enumerate(weight[f"odd.{parity}"].split(few, 1)):
                start = width + 1 + (2 + parity + 2 * half) * few
                rows[:, start : start + few] = odd
        gates = [
            (weight[name], weight[f"{name}.bias"]) for name in ("pair_gates", "gates.0", "gates.1")
        ]
        return FoldedNetwork(
            torch.cat(first)[:, :input_modes].contiguous(),
            torch.cat([weight["common"][:, :-1], constant[:, None]], 1),
            torch.cat([torch.cat([gate, bias[:, None]], 1) for gate, bias in gates]),
            torch.cat([weight["pairs"]] * 2),
            last,
        )


class FoldedNetwork(NamedTuple):
    """A network of one D/r0 as matrices, each with its bias as the column of a constant 1.

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
        """Return 1, of the mean, and the weights, sorted by parity, for Noll 4, 5, ... in rad."""
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


@dataclass(frozen=True)
class PSFBand:
    """The PSF basis and the networks for D/r0 up to `max_d_over_r0`.

    `mean` (fine, fine) and `basis` (rank, fine, fine) are PSFs sampled at
    SAMPLES_PER_LAMBDA_OVER_D; the basis is ordered by its share in a natural image, each function
    of one parity.  `networks`: from few modes to many.
    """

    max_d_over_r0: float
    mean: Float[Tensor, "fine fine"]
    basis: Float[Tensor, "rank fine fine"]
    networks: tuple[PhaseToSpaceNetwork, ...]


@cache
def load_bands_by_d_over_r0() -> tuple[PSFBand, ...]:
    """Return the fitted bands, weakest first."""
    return read_bands(load_file(FILE))


def read_bands(stored: Mapping[str, Tensor]) -> tuple[PSFBand, ...]:
    """Return the bands of tensors as `scripts.fit_p2s` names them, weakest first."""
    bands = []
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
    bands = load_bands_by_d_over_r0()
    limit = EDGE_MARGIN * bands[-1].max_d_over_r0
    if d_over_r0 > limit:
        raise ValueError(f"turbulence: D/r0 of the blur must be <= {limit:g}, got {d_over_r0:g}")
    return next(band for band in bands if d_over_r0 <= EDGE_MARGIN * band.max_d_over_r0)


class FittedPSFs:
    """The PSFs of one atmosphere on the pixels of one camera, from the basis and a network.

    `rank` basis functions of `band`, blurred by the phase that they lack, of the structure function
    `missing` (unresolved_blur.py), integrated over `size` x `size` pixels of lambda / D /
    `lambda_over_d_px`; the light that falls outside them is not in them.
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
        missing: StructureFunction | None = None,
    ):
        step, fine = SAMPLES_PER_LAMBDA_OVER_D / lambda_over_d_px, band.mean.shape[-1]
        grid = pixel_integration_matrix(size, fine, step).float()
        self.network, self.parity_ends, basis = _truncate(band, network, rank)
        if missing is not None:
            basis = blur_by_phase(basis, missing, fine)
        self.basis = grid @ basis @ grid.T
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
