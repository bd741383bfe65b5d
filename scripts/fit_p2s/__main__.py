"""Fit p2s.safetensors: python -m scripts.fit_p2s [STEPS] [--out FILE]

For each band of D/r0: exact PSFs of random Kolmogorov phase, a principal basis of them in the
metric of a natural picture (power 1 / f^2), networks from the first modes of the phase to the
weights of the whole PSF; then the tables of what each simplification costs
(src/sim/turbulence/fidelity.py), for which 0 steps keep the networks there are.  Nothing but
physics goes in.  FILE is written once, at the end; without it the simulator's own is replaced.
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor

from scripts.fit_p2s.errors import (
    draw_phase,
    exact_psfs,
    measure_error_tables,
    picture_metric,
    symmetrise_psf,
)
from scripts.fit_p2s.training import TrainableNetwork
from src.app.script import run_script
from src.records.atomic import atomic_path, check_writable
from src.sim.turbulence.p2s import EDGE_MARGIN, FILE, basis_parities, read_bands

SAMPLES = 160_000  # of a band


@dataclass(frozen=True)
class BandPlan:
    """What is fitted for D/r0 from `start` to `edge`; `sizes`: modes and width of each network."""

    start: float
    edge: float
    rank: int
    fine: int
    sizes: tuple[tuple[int, int], ...]


PLANS = (
    BandPlan(0.0, 1.0, 24, 35, ((9, 16), (14, 16), (20, 32), (35, 64))),
    BandPlan(1.0, 2.0, 24, 35, ((9, 16), (14, 16), (20, 32), (35, 64))),
    BandPlan(2.0, 3.0, 28, 35, ((9, 16), (14, 16), (20, 32), (44, 64))),
    BandPlan(3.0, 4.0, 32, 35, ((9, 16), (14, 16), (20, 32), (44, 64))),
    BandPlan(4.0, 5.5, 40, 41, ((14, 16), (20, 32), (35, 48), (54, 80))),
    BandPlan(5.5, 7.0, 40, 47, ((14, 16), (20, 32), (35, 48), (54, 96))),
    BandPlan(7.0, 10.0, 48, 47, ((20, 32), (35, 48), (54, 80), (77, 112))),
)


def fit_file(steps: int, out: Path) -> None:
    """Fit every band, measure what each simplification costs, and write the file `out`."""
    fitted = fit_bands(steps) if steps else load_file(FILE)
    networks = {name: t for name, t in fitted.items() if not name.startswith("errors.")}
    tables = measure_error_tables(read_bands(networks))
    with atomic_path(out) as partial:
        save_file(networks | tables, partial)


def fit_bands(steps: int) -> dict[str, Tensor]:
    """Return what is fitted, by band, network and name."""
    stored = {
        "edges": torch.tensor([plan.edge for plan in PLANS], dtype=torch.float64),
        "sizes": torch.tensor([plan.sizes for plan in PLANS]),
    }
    for index, plan in enumerate(PLANS):
        for name, tensor in fit_band(plan, steps).items():
            stored[f"{index}.{name}"] = tensor.contiguous()
    return stored


def fit_band(plan: BandPlan, steps: int) -> dict[str, Tensor]:
    """Return mean, basis and the layers of the networks of one band."""
    torch.manual_seed(int(1000 * plan.edge))
    strength = plan.start + (EDGE_MARGIN * plan.edge - plan.start) * torch.rand(SAMPLES, 1)
    phase = draw_phase(SAMPLES, strength)
    some = exact_psfs(phase[:12_000], plan.fine)
    mean, basis, project = principal_basis(some, plan.rank)
    weights = torch.cat(
        [(exact_psfs(part, plan.fine) - mean).flatten(1) @ project for part in phase.split(2000)]
    )
    found = {"mean": mean, "basis": basis.half()}
    for number, size in enumerate(plan.sizes):
        net = train_network(phase, strength, weights, size, basis_parities(basis), plan.edge, steps)
        found |= {f"{number}.{name}": value.half() for name, value in net.state_dict().items()}
    return found


def principal_basis(psfs: Tensor, rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, basis and the matrix that turns PSFs less mean into weights of unit size.

    Turbulence knows no left or right, so each function is sought among those that the mirror of the
    rows keeps or turns, and that of the columns.
    """
    mean = symmetrise_psf(psfs.mean(0))
    values, vectors = torch.linalg.eigh(picture_metric(psfs.shape[-1]))
    root = vectors * values.sqrt() @ vectors.T
    inverse = vectors / values.sqrt() @ vectors.T
    spreads, modes = [], []
    for down in (1, -1):
        for across in (1, -1):
            part = psfs - mean
            part = (part + down * part.flip(1)) / 2
            part = ((part + across * part.flip(2)) / 2).flatten(1).double()
            spread, own = torch.linalg.eigh(root @ (part.T @ part / len(part)) @ root)
            spreads.append(spread[-rank:])
            modes.append(own[:, -rank:])
    spread, best = torch.cat(spreads).topk(rank)
    top, scale = torch.cat(modes, dim=1)[:, best], spread[0].sqrt()
    basis = (inverse @ top * scale).T.reshape(rank, *mean.shape)
    return mean, basis.float(), (root @ top / scale).float()


def train_network(
    phase: Tensor,
    strength: Tensor,
    weights: Tensor,
    size: tuple[int, int],
    kinds: Tensor,
    edge: float,
    steps: int,
) -> TrainableNetwork:
    """Return the network after `steps` steps of Adam, their size falling to zero.

    Errors count as shares of the random power, which grows as (D/r0)^(5/3).
    """
    modes, width = size
    net = TrainableNetwork(modes, width, torch.bincount(kinds, minlength=4).tolist(), edge)
    seen, weights = phase[:, 2:modes].contiguous(), weights[:, kinds.argsort(stable=True)]
    net.scale_inputs(seen.std(0))
    power = ((strength / edge) ** (5 / 3)).clamp(min=0.05)[:, 0]
    optimiser = torch.optim.Adam(net.parameters(), fused=True)
    total = left = 0.0
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * (1 - step / steps) ** 1.5
        pick = torch.randint(len(seen), (1024,))
        error = (net(seen[pick], strength[pick]) - weights[pick]).square().sum(1)
        loss = (error / power[pick]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        if step >= 0.9 * steps:
            left += float(loss.detach())
            total += float((weights[pick].square().sum(1) / power[pick]).mean())
    print(f"{modes} modes, {width}: {left / total:.4f} left", flush=True)
    return net


def main() -> None:
    """Read the arguments."""
    parser = argparse.ArgumentParser("python -m scripts.fit_p2s", description=__doc__)
    parser.add_argument(
        "steps", type=int, nargs="?", default=12_000, help="default 12000; 0: tables only"
    )
    parser.add_argument("--out", type=Path, default=FILE, help="default: that of the simulator")
    given = parser.parse_args()
    if given.steps < 0:
        parser.error(f"steps must be >= 0, got {given.steps}")
    check_writable(given.out, "--out")
    fit_file(given.steps, given.out)


if __name__ == "__main__":
    run_script(main)
