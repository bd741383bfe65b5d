"""The networks that are compared: names, the views each is given, what is missing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from src.models.network import EventToVideoNetwork, FramePostprocessor
from src.sim.optics import Position, layout


@dataclass(frozen=True)
class Candidate:
    """A network of a comparison, None where it is missing.

    `views`: how many views of the light field it is given (1: the centre view).  `trained`: its
    weights are here; without them only its speed is measured.  `missing_reason`: why there is no
    network.  `postprocessor`: run on its frames.
    """

    name: str
    network: EventToVideoNetwork | None
    views: int
    trained: bool = True
    missing_reason: str = ""
    postprocessor: FramePostprocessor | None = None

    @property
    def loaded(self) -> EventToVideoNetwork:
        """The network; raises ValueError where it is missing."""
        if self.network is None:
            raise ValueError(self.missing_reason)
        return self.network

    def select_views(
        self, voxels: Float[Tensor, "n views bins h w"], positions: Sequence[Position]
    ) -> tuple[Float[Tensor, "n chosen bins h w"], list[Position]]:
        """Return the views that the network is given, and their positions.

        Raises ValueError where the light field has fewer.
        """
        chosen = [place for place in layout(self.views) if place in positions]
        if len(chosen) < self.views:
            raise ValueError(f"the light field has {len(positions)} views, {self.views} are needed")
        return voxels[:, [positions.index(place) for place in chosen]], chosen

    @torch.no_grad()
    def reconstruct(
        self, windows: Iterable[Float[Tensor, "1 views bins h w"]], positions: Sequence[Position],
        window_s: float, state: Any = None,
    ) -> tuple[Float[Tensor, "windows 1 h w"], Any]:  # fmt: skip
        """Return the frames of `windows`, one by one, float32 in [0, 1], post-processed as one
        video, and the state after them.
        """
        frames = []
        for voxels in windows:
            chosen, places = self.select_views(voxels, positions)
            frame, state = self.loaded(chosen, state, window_s=window_s, positions=places)
            frames.append(frame.float().clamp(0, 1))
        video = torch.cat(frames)
        if self.postprocessor is not None:
            video = self.postprocessor.restore(video[None])[0]
        return video, state

    def require_float_parameters(self, consequence: str) -> None:
        """Raise ValueError, with its `consequence`, unless it has parameters to differentiate."""
        if not any(p.is_floating_point() for p in self.loaded.parameters()):
            raise ValueError(f"it has no parameters, {consequence}")
