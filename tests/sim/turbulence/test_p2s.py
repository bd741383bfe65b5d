"""The networks from phase to PSF weights: their symmetries, and their merged layers."""

import numpy as np
import pytest
import torch
from torch.nn import functional

from scripts.fit_p2s.exact_psf import fraunhofer_psf
from scripts.fit_p2s.training import TrainableNetwork
from src.sim.turbulence.engines.network_numba import BLOCK, evaluate_psf_network
from src.sim.turbulence.p2s import (
    PhaseToSpaceNetwork,
    basis_parities,
    mirror_symmetry_class,
)
from src.sim.turbulence.zernike import noll_index

COUNTS = [5, 3, 2, 3]
KINDS = torch.arange(4).repeat_interleave(torch.tensor(COUNTS))


def phases(modes: int, count: int = 300) -> torch.Tensor:
    return torch.randn(count, modes - 2, generator=torch.Generator().manual_seed(1))


def network(modes: int, width: int = 16) -> TrainableNetwork:
    torch.manual_seed(0)
    return TrainableNetwork(modes, width, COUNTS, max_d_over_r0=4.0).requires_grad_(False)


def stored(net: TrainableNetwork) -> PhaseToSpaceNetwork:
    return PhaseToSpaceNetwork(net.modes, net.max_d_over_r0, net.state_dict())


def turned(phase: torch.Tensor, down: bool, across: bool) -> torch.Tensor:
    """Mirror the rows and the columns of a phase."""
    kinds = torch.tensor([mirror_symmetry_class(mode) for mode in range(4, 4 + phase.shape[1])])
    odd = (down & (kinds // 2 == 1)) ^ (across & (kinds % 2 == 1))
    return torch.where(odd, -phase, phase)


@pytest.mark.parametrize("down, across", [(True, False), (False, True), (True, True)])
def test_a_mirrored_phase_has_mirrored_weights(down, across):
    net, phase = network(27), phases(27)
    odd = (down & (KINDS // 2 == 1)) ^ (across & (KINDS % 2 == 1))
    mirrored = net(turned(phase, down, across), 3.0)
    torch.testing.assert_close(mirrored, torch.where(odd, -1, 1) * net(phase, 3.0))
    assert (mirrored - net(phase, 3.0))[:, odd].abs().max() > 0.01


def test_half_a_turn_and_another_sign_change_nothing():
    """|F(P exp(i phi))| is that of -phi(-x), as that field is the conjugate, turned."""
    net, phase = network(27), phases(27)
    even = torch.tensor([noll_index(mode)[0] % 2 == 0 for mode in range(4, 28 + 1)])
    other = torch.where(even, -phase, phase)
    torch.testing.assert_close(net(other, 3.0), net(phase, 3.0))
    full = (torch.nn.functional.pad(some[:2], (2, 0)) for some in (phase, other))
    one, two = (fraunhofer_psf(some, lambda_over_d_px=2.0, size=21) for some in full)
    torch.testing.assert_close(one, two, atol=1e-6, rtol=0)


@pytest.mark.parametrize("modes, width", [(5, 16), (20, 32), (77, 112)])
@pytest.mark.parametrize("given", [0, 2, 18, 75, 90])
def test_few_large_matrices_equal_the_network(modes, width, given):
    net, phase = network(modes, width), phases(max(modes, given + 2))[:, :given]
    known = functional.pad(phase, (0, max(0, modes - 2 - given)))[:, : modes - 2]
    one, *found = stored(net).merge_into_few_matrices(given, 3.0)(phase.T.contiguous())
    assert torch.equal(one, torch.ones(len(phase)))
    found = torch.stack(found, 1)
    torch.testing.assert_close(found, net(known, 3.0), atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("counts", [[5, 3, 2, 3], [3, 1, 1, 0], [1, 0, 0, 0]])
def test_a_cut_network_gives_the_first_functions_of_each_kind(counts):
    net, phase = network(20), phases(20)
    kept = [np.arange(k) + start for k, start in zip(counts, (0, 5, 8, 10), strict=True)]
    whole = net(phase, 2.0)[:, np.concatenate(kept)]
    cut = stored(net).truncate(counts)
    torch.testing.assert_close(cut.merge_into_few_matrices(18, 2.0)(phase.T)[1:].T, whole)
    assert cut.count_macs(sum(counts)) <= stored(net).count_macs(13)


@pytest.mark.parametrize("modes, width, given", [(5, 16, 3), (20, 32, 2), (77, 112, 90)])
@pytest.mark.parametrize("counts", [[5, 3, 2, 3], [1, 0, 0, 0]])
def test_the_compiled_network_equals_the_matrices(modes, width, given, counts):
    torch.manual_seed(0)
    folded = stored(network(modes, width)).truncate(counts).merge_into_few_matrices(given, 3.0)
    phase = torch.randn(given, 2 * BLOCK + 7)
    matrices = folded._replace(last=folded.last[1:])
    found = evaluate_psf_network(phase.numpy(), *(matrix.numpy() for matrix in matrices))
    expected = folded(phase)[1:]
    torch.testing.assert_close(torch.from_numpy(found), expected, atol=2e-5, rtol=1e-4)


def test_kinds_of_shapes():
    x = torch.linspace(-1, 1, 9)
    even, odd = torch.exp(-(x**2)), x * torch.exp(-(x**2))
    shapes = [even[:, None] * even, even[:, None] * odd, odd[:, None] * even, odd[:, None] * odd]
    assert basis_parities(torch.stack(shapes)).tolist() == [0, 1, 2, 3]
