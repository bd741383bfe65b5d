"""Which network runs on how many views: chosen by hand, or as much as the time allows."""

from collections.abc import Sequence
from dataclasses import dataclass

from src.sim.optics import Position, layout

COUNTS = (1, 3, 5, 9)  # views to choose from, where the light field has them
ROOMY = 0.75  # of the time of a window: a level that takes less is gone up to
CALM = 1.0  # seconds without a backlog before going up
SETTLE = 3  # windows in which a step down shows whether the backlog shrinks
RETRY = 20.0  # seconds after which the time a level takes is no longer known


@dataclass(frozen=True)
class Level:
    """The name of a network and how many views it is given."""

    network: str
    views: int


def choices(wants: int | None, places: Sequence[Position]) -> list[int]:
    """Return the numbers of views that a network that `wants` so many (None: any) can be given."""
    there = set(places)
    if wants is not None:
        return [wants]
    counts = {count for count in COUNTS if set(layout(count)) <= there}
    return sorted(counts | {len(places)})


def positions(views: int, places: Sequence[Position]) -> list[Position]:
    """Return which of `places` are looked at: all, or those of the layout of `views`.

    Raises ValueError where the light field has not got them.
    """
    if views == len(places):
        return list(places)
    chosen = list(layout(views))
    if not set(chosen) <= set(places):
        raise ValueError(f"ckpt wants the views {chosen}, the recording has {list(places)}")
    return chosen


def ladder(networks: Sequence[str], counts: dict[str, list[int]]) -> list[Level]:
    """Return levels from the most to the least: fewer views first, then smaller networks.

    `networks` from the largest to the smallest; `counts`: the views each can be given.
    """
    first, *smaller = networks
    down = [Level(first, views) for views in sorted(counts[first], reverse=True)]
    return down + [Level(name, min(counts[name])) for name in smaller]


class Shedding:
    """Goes down `levels` when windows wait, and up again when there is time.

    `period_s`: the time there is for a window; `room`: how many may wait before they are dropped.
    """

    def __init__(self, levels: Sequence[Level], *, period_s: float, room: int):
        self.levels, self.period_s = list(levels), period_s
        self.room, self.full = room, max(1, room // 2)
        self.index = 0
        self.taken: dict[int, tuple[float, float]] = {}  # of each level: seconds, wall
        self.since = 0.0  # when a backlog, or a change, was last seen
        self.settling = 0  # windows before the next step down
        self.waited = 0  # windows that waited when a step down was last thought of

    @property
    def level(self) -> Level:
        """The level that runs."""
        return self.levels[self.index]

    def after(self, seconds: float, waiting: int, now: float) -> Level:
        """Return the level for the next window: one took `seconds`, `waiting` are left at `now`."""
        before, _ = self.taken.get(self.index, (seconds, now))
        self.taken[self.index] = (0.8 * before + 0.2 * seconds, now)
        self.settling -= 1
        if waiting < self.full:
            self.waited = 0
        else:
            self.since = now
            if self.settling <= 0 and self._down(waiting):
                self._move(self.index + 1, now)
        if self.index and now - self.since > CALM and self._fits(self.index - 1, now):
            self._move(self.index - 1, now)
        return self.level

    def _down(self, waiting: int) -> bool:
        """Return whether to go down: the backlog has grown since that was last thought of."""
        grows = waiting > self.waited or waiting >= self.room - 1
        self.waited, self.settling = waiting, SETTLE
        return grows and self.index + 1 < len(self.levels)

    def _fits(self, index: int, now: float) -> bool:
        seconds, seen = self.taken.get(index, (0.0, now))
        return now - seen > RETRY or seconds < ROOMY * self.period_s

    def _move(self, index: int, now: float) -> None:
        self.index, self.since, self.settling = index, now, SETTLE
