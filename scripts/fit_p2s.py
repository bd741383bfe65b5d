"""Fit p2s.safetensors: python -m scripts.fit_p2s [steps, default 25000; 0: tables only].

For each band of D/r0: exact PSFs of random Kolmogorov phase, a principal basis of them in the
metric of a natural picture (power 1 / f^2), a network from phase to weights; then the tables of
what each simplification costs (fidelity.py), for which 0 steps keep the networks there are.
Nothing but physics goes in.
"""

import sys
from dataclasses import dataclass

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from scripts.p2s_errors import measure, picture_metric
from src.sim.turbulence.p2s import FILE, FINE_PER_AIRY
from src.sim.turbulence.psf import fraunhofer_psf
from src.sim.turbulence.zernike import noll_covariance


@dataclass(frozen=True)
class Plan:
    """What is fitted for D/r0 up to `edge`."""

    edge: float
    modes: int
    rank: int
    hidden: int
    fine: int
    samples: int = 160_000


PLANS = (
    Plan(1.0, 27, 24, 64, 35),
    Plan(2.0, 35, 24, 96, 35),
    Plan(4.0, 44, 32, 160, 35),
    Plan(7.0, 54, 40, 256, 47),
    Plan(10.0, 77, 48, 288, 47),
)


def fit(steps: int) -> None:
    """Fit every band, measure what each simplification costs, and write the file."""
    if steps:
        save_file(fit_bands(steps), FILE)
    networks = {name: t for name, t in load_file(FILE).items() if not name.startswith("errors.")}
    save_file(networks | measure(), FILE)


def fit_bands(steps: int) -> dict[str, Tensor]:
    """Return what is fitted, by band and name."""
    stored = {"edges": torch.tensor([plan.edge for plan in PLANS])}
    for index, plan in enumerate(PLANS):
        for name, tensor in fit_band(plan, steps).items():
            stored[f"{index}.{name}"] = tensor.contiguous()
    return stored


def fit_band(plan: Plan, steps: int) -> dict[str, Tensor]:
    """Return mean, basis and layers of one band."""
    torch.manual_seed(int(1000 * plan.edge))
    phase = draw_phase(plan, plan.samples)
    some = exact(phase[:12_000], plan)
    mean, basis, project = principal(some, plan.rank)
    offset = mean.flatten()
    weights = [(exact(part, plan).flatten(1) - offset) @ project for part in phase.split(2000)]
    net = train(plan, phase[:, 2:], torch.cat(weights), steps)
    return {"mean": mean, "basis": basis.half(), **net.state_dict()}


def draw_phase(plan: Plan, count: int) -> Tensor:
    """Return Noll 2..modes + 1 (count, modes), no tilt, for D/r0 in the band and just beyond."""
    low = 0.0 if plan.edge == PLANS[0].edge else 0.4 * plan.edge
    strength = low + (1.06 * plan.edge - low) * torch.rand(count, 1)
    mix = torch.linalg.cholesky(noll_covariance(plan.modes)).float()
    phase = torch.randn(count, plan.modes) @ mix.T * strength ** (5 / 6)
    phase[:, :2] = 0
    return phase


def exact(phase: Tensor, plan: Plan) -> Tensor:
    """Return the exact PSFs, sampled as the basis is."""
    pupil = plan.fine - 3  # aliases fall outside the window by their own width
    return fraunhofer_psf(phase, airy_px=FINE_PER_AIRY, size=plan.fine, pupil=pupil, points=1)


def principal(psfs: Tensor, rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, basis and the matrix that turns PSFs less mean into weights of unit size."""
    mean = psfs.mean(0)
    rest = (psfs - mean).flatten(1).double()
    values, vectors = torch.linalg.eigh(picture_metric(psfs.shape[-1]))
    root = vectors * values.sqrt() @ vectors.T
    inverse = vectors / values.sqrt() @ vectors.T
    spread, modes = torch.linalg.eigh(root @ (rest.T @ rest / len(rest)) @ root)
    top, scale = modes.flip(1)[:, :rank], spread.flip(0)[0].sqrt()
    basis = (inverse @ top * scale).T.reshape(rank, *mean.shape)
    return mean, basis.float(), (root @ top / scale).float()


def train(plan: Plan, phase: Tensor, weights: Tensor, steps: int) -> nn.Sequential:
    """Return the network after `steps` steps of Adam, their size falling to zero."""
    size = plan.hidden
    net = nn.Sequential(
        nn.Linear(phase.shape[1], size),
        nn.SiLU(),
        nn.Linear(size, size),
        nn.SiLU(),
        nn.Linear(size, plan.rank),
    )
    with torch.no_grad():
        net[0].weight /= phase.std(0)
    optimiser = torch.optim.Adam(net.parameters(), fused=True)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * (1 - step / steps) ** 1.5
        pick = torch.randint(len(phase), (1024,))
        loss = (net(phase[pick]) - weights[pick]).square().sum(1).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    print(f"{plan}: {float(loss.detach() / weights.square().sum(1).mean()):.4f} unexplained")
    return net


if __name__ == "__main__":
    fit(int(sys.argv[1]) if len(sys.argv) > 1 else 25_000)
