"""No more views and no larger a network than the air asks for, decided as it goes.

Where the views agree, one of them says all; where they do not, more are looked at, by a larger
network if there is one.  The views are compared before any network runs, so that one view is
enough to go on and all are known when it is not.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from src.models.setnet import CELL, SetNet, State
from src.sim.optics import Position, layout

BLOCK = 4  # pixels of a block in which events are added up before views are compared
MEMORY_S = 0.1  # over which they are
SETTLED_S = 0.05  # from the start, in which few events say little and no level is left upwards
BELOW = 0.7  # of the bound of a level has to be undercut to leave it


@dataclass(frozen=True)
class Level:
    """A network, how many views it is given, and what figures call it."""

    network: SetNet
    views: int
    name: str = ""


@dataclass(frozen=True)
class Held:
    """The state: which level runs, with what state, what the views said, the windows it was calm,
    and the time since the start in seconds.

    `coming`: the level that takes over, its state, and after how many windows.
    """

    level: int
    own: State | None
    sums: Tensor
    disagreement: float
    calm: int
    age_s: float
    coming: tuple[int, State, int] | None = None


class Adaptive(nn.Module):
    """`levels`, from the least to the most, for growing disagreement of the views.

    Disagreement is the rms difference of a view's events from the mean view's over the rms of the
    mean's: 0 where all see the same.  `tolerance` > 0: above it the last level runs, above even
    shares of it those between.  A level is left downwards after `patience` calm windows; a larger
    network runs along for `handover` windows before its frames are shown.  Clips of a batch share a
    level.  Raises ValueError for values outside these.
    """

    views = None

    def __init__(
        self, levels: Sequence[Level], *, tolerance: float, patience: int = 12, handover: int = 6
    ):
        super().__init__()
        if len(levels) < 2:
            raise ValueError(f"adapt.levels must be at least 2, got {len(levels)}")
        if not 0 < tolerance < math.inf:
            raise ValueError(f"adapt.tolerance must be > 0, got {tolerance}")
        if patience < 1 or handover < 0:
            raise ValueError(
                f"adapt.patience must be >= 1, handover >= 0, got {patience}, {handover}"
            )
        self.levels, self.patience, self.handover = tuple(levels), patience, handover
        different = {id(level.network): level.network for level in levels}
        self.networks = nn.ModuleList(different.values())
        last = len(levels) - 1
        self.bounds = [tolerance * (k + 1) / last for k in range(last)]

    @torch.no_grad()
    def forward(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        state: Held | None = None,
        *,
        window_s: float = 1 / 120,
        positions: Sequence[Position] | None = None,
    ) -> tuple[Float[Tensor, "n 1 h w"], Held]:
        """Return the frame and the state; `voxels` hold all views, whatever is looked at."""
        places = list(positions or layout(voxels.shape[1]))
        held = self._measured(voxels, state, window_s)
        held = self._decided(held, places)
        if held.coming is not None:
            held = self._hand_over(voxels, held, places, window_s)
        frame, own = self.run(voxels, held.level, held.own, places, window_s=window_s)
        return frame, replace(held, own=own)

    def _measured(self, voxels: Tensor, state: Held | None, window_s: float) -> Held:
        block = min(BLOCK, *voxels.shape[-2:])
        sums = functional.avg_pool2d(voxels.float().sum(2), block)
        if state is not None:
            sums = sums + math.exp(-window_s / MEMORY_S) * state.sums
        mean = sums.mean(1, keepdim=True)
        spread = (sums - mean).square().mean().sqrt()
        apart = float(spread / mean.square().mean().sqrt().clamp(min=1e-9)) if spread > 0 else 0.0
        if state is None:
            return Held(0, None, sums, apart, 0, window_s)
        return replace(state, sums=sums, disagreement=apart, age_s=state.age_s + window_s)

    def _decided(self, held: Held, places: list[Position]) -> Held:
        """Go up at once, down one level at a time and only after calm."""
        aim = sum(held.disagreement > bound for bound in self.bounds)
        now = held.level if held.coming is None else held.coming[0]
        if aim > now and held.age_s > SETTLED_S:
            return self._changed(held, aim, places)
        if now == 0 or held.disagreement > BELOW * self.bounds[now - 1]:
            return replace(held, calm=0)
        if held.calm + 1 < self.patience:
            return replace(held, calm=held.calm + 1)
        return self._changed(held, now - 1, places)

    def _changed(self, held: Held, level: int, places: list[Position]) -> Held:
        """Move to `level`: at once with the same network, else let the other run along first."""
        held = replace(held, calm=0, coming=None)
        if level == held.level:
            return held
        before, after = self.levels[held.level], self.levels[level]
        own = _reviewed(held.own, _chosen(before.views, places), _chosen(after.views, places))
        if before.network is after.network:
            return replace(held, level=level, own=own)
        return replace(held, coming=(level, _emptied(own, after.network), self.handover))

    def _hand_over(
        self, voxels: Tensor, held: Held, places: list[Position], window_s: float
    ) -> Held:
        level, own, left = held.coming
        if left == 0:
            return replace(held, level=level, own=own, coming=None)
        _, own = self.run(voxels, level, own, places, window_s=window_s)
        return replace(held, coming=(level, own, left - 1))

    def run(
        self,
        voxels: Float[Tensor, "n views bins h w"],
        level: int,
        own: State | None,
        places: list[Position],
        *,
        window_s: float,
    ) -> tuple[Float[Tensor, "n 1 h w"], State]:
        """Return frame and state of one level, which is given its views of all at `places`."""
        chosen = _chosen(self.levels[level].views, places)
        seen = voxels[:, [places.index(place) for place in chosen]]
        return self.levels[level].network(seen, own, positions=chosen, window_s=window_s)


def _chosen(views: int, places: list[Position]) -> list[Position]:
    """Return the positions of a level; ValueError where the light field has not got them."""
    chosen = list(layout(views))
    if not set(chosen) <= set(places):
        raise ValueError(f"adapt.levels must be of views that are there, {places}, got {views}")
    return chosen


def _reviewed(own: State, before: list[Position], after: list[Position]) -> State:
    """Return a state of SetNet for other views: a new one starts from the mean of those known."""
    sums, *rest = own
    mean = sums.mean(1)
    parts = [sums[:, before.index(place)] if place in before else mean for place in after]
    return (torch.stack(parts, 1), *rest)


def _emptied(own: State, network: SetNet) -> State:
    """Return the state for another network: sums of events stay, its own maps start."""
    sums, awake, recent, *_ = own
    sizes, never = network.hidden(*(CELL * side for side in sums.shape[-2:])), 0 * recent
    return (sums, awake, never, *(sums.new_zeros(len(sums), *size) for size in sizes))
