"""Published single-view networks widened to a light field, to be trained on from there.

Only the first convolution changes: it sees all views, stacked as channels (channel = view * bins +
bin), and starts as the published kernel tiled over the views, divided by their number and times
GAIN.  What was learned about events stays; what turbulence does to views is left to be learned.
"""

from collections.abc import Sequence
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from baselines import upstream
from baselines.cista import CISTA
from baselines.firenet import FireNet
from src.sim.optics import Position
from src.sim.voxel import normalise_nonzero

GAIN = 1.5  # turbulence spreads an edge's events over the views: their mean is weaker than one view


class LightFieldFireNet(FireNet):
    """FireNet on `views` views; with nine, 43,537 parameters.  `normalise` is of each view alone.

    As published for FireNet+: normalise none, output clip.
    """

    published = "firenet_plus"

    def __init__(self, views: int = 9, bins: int = 5, channels: int = 16, **how: Any):
        super().__init__(bins, channels, **how)
        self.views = views
        self.head = nn.Conv2d(views * bins, channels, 3, padding=1)

    def see(
        self, voxels: Float[Tensor, "n views bins h w"], positions: Sequence[Position] | None
    ) -> Float[Tensor, "n c h w"]:
        """Return all views, stacked."""
        return stack(voxels, self)


class LightFieldCISTA(CISTA):
    """CISTA-TC on `views` views; with nine, 1,272,387 parameters.  `normalise` is of each view
    alone.  As published: normalise nonzero, output sigmoid.
    """

    published = "cista"

    def __init__(self, views: int = 9, bins: int = 5, channels: int = 32, **how: Any):
        super().__init__(bins, channels, **how)
        self.views = views
        self.events = nn.Conv2d(views * bins, channels, 3, padding=1, padding_mode="reflect")

    def see(
        self, voxels: Float[Tensor, "n views bins h w"], positions: Sequence[Position] | None
    ) -> Float[Tensor, "n c h w"]:
        """Return all views, stacked."""
        return stack(voxels, self)


def start(network: nn.Module, weights: str) -> None:
    """Give `network` the published weights of a file (see upstream.from_config), widened, in place.

    Raises ValueError, naming `model.weights`, for a network that none were published for, for a
    file without them, and for weights of another width.
    """
    name = getattr(network, "published", None)
    if name is None:
        kind = type(network).__name__
        raise ValueError(f"model.weights must be null for {kind}, got {weights}")
    try:
        own = upstream.from_config(name, weights).state_dict()
    except ValueError as error:
        raise ValueError(str(error).replace("baseline.weights", "model.weights", 1)) from error
    first = f"{upstream.NETWORKS[name].first}.weight"
    own[first] = GAIN * upstream.widen(own[first], network.views)
    wanted = network.state_dict()
    other = sorted(key for key in wanted if own[key].shape != wanted[key].shape)
    if other:
        raise ValueError(
            f"model.weights must have the sizes of model.channels and bins, got others in "
            f"{', '.join(other)} of {weights}"
        )
    with torch.no_grad():
        network.load_state_dict(own)


def stack(
    voxels: Float[Tensor, "n views bins h w"], network: nn.Module
) -> Float[Tensor, "n c h w"]:
    """Return all views as channels, each as `network.normalise` has it.

    Raises ValueError when views or bins are not the network's.
    """
    wanted, got = (network.views, network.bins), tuple(voxels.shape[1:3])
    if got != wanted:
        raise ValueError(f"optics.views, bins must be {wanted} for this network, got {got}")
    seen = normalise_nonzero(voxels) if network.normalise == "nonzero" else voxels
    return seen.flatten(1, 2)
