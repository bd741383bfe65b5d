"""Give the memory of a SetNet that is trained in full a rank (see PacedUnit).

What it is told, its gates and candidates before their non-linearities, is kept in as many principal
components of what it is on clips of the training.
"""

import torch
from jaxtyping import Float
from omegaconf import DictConfig
from torch import Tensor

from src.app import build
from src.models.setnet import SetNet
from src.models.unroll import video
from src.sim.pipeline import simulate

CLIPS, PLACES = 10, 2000  # of the training; drawn of every AT_ONCE windows (unroll)

Told = Float[Tensor, "places outputs"]


@torch.no_grad()
def told(network: SetNet, cfg: DictConfig) -> Told:
    """Return what the memory of `network` is told at places drawn in clips of the training."""
    found, pipeline = [], build.pipeline(cfg, "train")

    def keep(_, __, maps: Tensor) -> None:
        places = maps.movedim(1, -1).flatten(0, -2)
        found.append(places[torch.randint(len(places), (PLACES,))])

    hook = network.cell2.seen.register_forward_hook(keep)
    for clip in range(CLIPS):
        video(network, simulate(pipeline, [clip]))
    hook.remove()
    return torch.cat(found)


@torch.no_grad()
def narrow(network: SetNet, rank: int, told: Told) -> SetNet:
    """Return a SetNet with a memory of `rank` that draws nearly what `network` does; ValueError for
    a rank beyond what the memory is told.
    """
    if rank > told.shape[1]:
        raise ValueError(f"rank must be <= {told.shape[1]} for this network, got {rank}")
    mean = told.mean(0)
    _, components = torch.linalg.eigh(torch.cov(told.T))  # the largest come last
    kept = components[:, -rank:]
    weights = network.state_dict()
    kernel, bias = (weights[f"cell2.seen.{part}"] for part in ("weight", "bias"))
    weights["cell2.mixed.weight"] = torch.einsum("or,oikl->rikl", kept, kernel)
    weights["cell2.seen.weight"] = kept[..., None, None]
    weights["cell2.seen.bias"] = mean + kept @ (kept.T @ (bias - mean))
    narrowed = SetNet(**network.arguments, rank=rank)
    narrowed.load_state_dict(weights)
    return narrowed
