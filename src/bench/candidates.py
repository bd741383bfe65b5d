"""The networks that are compared: what each is called, which views it is given, what is missing."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from src.models.unroll import accepted
from src.sim.optics import layout


@dataclass(frozen=True)
class Candidate:
    """A line of the chart or a column of the stress map.

    `views`: how many views of the light field it is given (1: the centre view).  `trained`: its
    weights are here; without them only speed means anything.  `missing`: why there is no network at
    all, in plain words.  `restorer`: a post-processor of frames behind it.
    """

    name: str
    network: nn.Module | None
    views: int
    trained: bool = True
    missing: str = ""
    restorer: nn.Module | None = None

    @property
    def parts(self) -> list[nn.Module]:
        """The network and what is behind it, as far as they are here."""
        return [part for part in (self.network, self.restorer) if part is not None]


@dataclass(frozen=True)
class Subject:
    """A network with the views it is given: `views` 1 is the centre view."""

    name: str
    network: nn.Module
    views: int

    def choose(self, voxels: Tensor, positions: Sequence) -> tuple[Tensor, list]:
        """Return the views (axis 1 of `voxels`) that the network is given, and where they stand."""
        chosen = [place for place in layout(self.views) if place in positions]
        if len(chosen) < self.views:
            raise ValueError(f"the light field has {len(positions)} views, {self.views} are needed")
        return voxels[:, [positions.index(place) for place in chosen]], chosen

    @torch.no_grad()
    def step(
        self, voxels: Tensor, state: Any, positions: Sequence, window_s: float
    ) -> tuple[Tensor, Any]:
        """Return the frame (1, 1, h, w), clipped, float32, and the state."""
        options = accepted(self.network, window_s=window_s, positions=positions)
        frame, state = self.network(voxels, state, **options)
        return frame.float().clamp(0, 1), state

    def play(
        self, windows: Iterable[Tensor], positions: Sequence, window_s: float, state: Any = None
    ) -> tuple[Tensor, Any]:
        """Return frames (windows, 1, h, w) and the state after `windows` (1, views, bins, h, w)."""
        frames = []
        for voxels in windows:
            chosen, places = self.choose(voxels, positions)
            frame, state = self.step(chosen, state, places, window_s)
            frames.append(frame)
        return torch.cat(frames), state

    def needs_views(self, least: int = 2) -> None:
        """Raise ValueError unless it is given at least so many views."""
        if self.views < least:
            raise ValueError("it is given the centre view only")
