"""Fit p2s.safetensors: python -m scripts.fit_p2s [steps, default 16000; 0: tables only].

For each band of D/r0: exact PSFs of random Kolmogorov phase, a principal basis of them in the
metric of a natural picture (power 1 / f^2), networks from the first modes of the phase to the
weights of the whole PSF; then the tables of what each simplification costs
(src/sim/turbulence/fidelity.py), for which 0 steps keep the networks there are.  Nothing but
physics goes in.
"""

import sys
from dataclasses import dataclass

import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from scripts.p2s_errors import ALL_MODES, even, measure, picture_metric
from src.sim.turbulence.fidelity import BEYOND
from src.sim.turbulence.p2s import FILE, FINE_PER_AIRY
from src.sim.turbulence.psf import fraunhofer_psf
from src.sim.turbulence.zernike import noll_covariance


@dataclass(frozen=True)
class Plan:
    """What is fitted for D/r0 from `start` to `edge`; `sizes`: modes and the two hidden layers."""

    start: float
    edge: float
    rank: int
    fine: int
    sizes: tuple[tuple[int, int, int], ...]
    samples: int = 160_000


PLANS = (
    Plan(0.0, 1.0, 24, 35, ((9, 24, 16), (14, 32, 24), (27, 64, 48))),
    Plan(1.0, 2.0, 24, 35, ((9, 32, 24), (20, 48, 32), (35, 96, 64))),
    Plan(2.0, 3.0, 28, 35, ((14, 48, 32), (20, 64, 48), (44, 96, 96))),
    Plan(3.0, 4.0, 32, 35, ((14, 48, 32), (27, 64, 48), (44, 128, 96))),
    Plan(4.0, 5.5, 40, 41, ((20, 64, 48), (35, 96, 96), (54, 160, 96))),
    Plan(5.5, 7.0, 40, 47, ((20, 64, 48), (35, 128, 96), (54, 160, 128))),
    Plan(7.0, 10.0, 48, 47, ((27, 64, 48), (44, 128, 96), (77, 192, 128))),
)


class Square(nn.Module):
    """x squared."""

    def forward(self, x: Tensor) -> Tensor:
        """Return it."""
        return x * x


def fit(steps: int) -> None:
    """Fit every band, measure what each simplification costs, and write the file."""
    if steps:
        save_file(fit_bands(steps), FILE)
    networks = {name: t for name, t in load_file(FILE).items() if not name.startswith("errors.")}
    save_file(networks | measure(), FILE)


def fit_bands(steps: int) -> dict[str, Tensor]:
    """Return what is fitted, by band, network and name."""
    stored = {
        "edges": torch.tensor([plan.edge for plan in PLANS], dtype=torch.float64),
        "sizes": torch.tensor(len(PLANS[0].sizes)),
    }
    for index, plan in enumerate(PLANS):
        for name, tensor in fit_band(plan, steps).items():
            stored[f"{index}.{name}"] = tensor.contiguous()
    return stored


def fit_band(plan: Plan, steps: int) -> dict[str, Tensor]:
    """Return mean, basis and the layers of the networks of one band."""
    torch.manual_seed(int(1000 * plan.edge))
    strength = plan.start + (BEYOND * plan.edge - plan.start) * torch.rand(plan.samples, 1)
    phase = draw_phase(strength)
    some = exact(phase[:12_000], plan.fine)
    mean, basis, project = principal(some, plan.rank)
    weights = torch.cat(
        [(exact(part, plan.fine) - mean).flatten(1) @ project for part in phase.split(2000)]
    )
    variance = (strength / plan.edge) ** (5 / 3)
    found = {"mean": mean, "basis": basis.half()}
    for number, (modes, *hidden) in enumerate(plan.sizes):
        seen = torch.cat([phase[:, 2:modes], variance], dim=1)
        net = train(seen, weights, hidden, steps)
        found |= {f"{number}.{name}": value.half() for name, value in net.state_dict().items()}
    return found


def draw_phase(strength: Tensor) -> Tensor:
    """Return Noll 2..ALL_MODES + 1 (count, modes), no tilt, for D/r0 = `strength` (count, 1)."""
    mix = torch.linalg.cholesky(noll_covariance(ALL_MODES)).float()
    phase = torch.randn(len(strength), ALL_MODES) @ mix.T * strength ** (5 / 6)
    phase[:, :2] = 0
    return phase


def exact(phase: Tensor, fine: int) -> Tensor:
    """Return the exact PSFs, sampled as the basis is."""
    pupil = fine - 3  # aliases fall outside the window by their own width
    return fraunhofer_psf(phase, airy_px=FINE_PER_AIRY, size=fine, pupil=pupil, points=1)


def principal(psfs: Tensor, rank: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return mean, basis and the matrix that turns PSFs less mean into weights of unit size.

    Turbulence knows no left or right, so each function is sought among those that the mirror of the
    rows keeps or turns, and that of the columns.
    """
    mean = even(psfs.mean(0))
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


def train(seen: Tensor, weights: Tensor, hidden: list[int], steps: int) -> nn.Sequential:
    """Return the network after `steps` steps of Adam, their size falling to zero.

    `seen` (n, inputs) ends with (D/r0)^(5/3) of the band's edge, by which the random power grows:
    errors count as shares of it.
    """
    wide, narrow = hidden
    net = nn.Sequential(
        nn.Linear(seen.shape[1], wide),
        Square(),
        nn.Linear(wide, narrow),
        nn.SiLU(),
        nn.Linear(narrow, weights.shape[1]),
    )
    with torch.no_grad():
        net[0].weight /= seen.std(0)
    power = seen[:, -1].clamp(min=0.05)
    optimiser = torch.optim.Adam(net.parameters(), fused=True)
    for step in range(steps):
        for group in optimiser.param_groups:
            group["lr"] = 3e-3 * (1 - step / steps) ** 1.5
        pick = torch.randint(len(seen), (1024,))
        error = (net(seen[pick]) - weights[pick]).square().sum(1)
        loss = (error / power[pick]).mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    print(f"{seen.shape[1] + 1} modes, {hidden}: {float(loss.detach()):.4f} left", flush=True)
    return net


if __name__ == "__main__":
    fit(int(sys.argv[1]) if len(sys.argv) > 1 else 16_000)
