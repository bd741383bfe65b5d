"""What a visitor can choose: a network, and a number of views or as many as the time allows."""

import threading
from collections.abc import Mapping, Sequence

from torch import nn

from src.live_view import quality
from src.live_view.network_step import Running, Step
from src.live_view.quality import Level, Shedding
from src.live_view.reconstruction import Choice, Reconstruction
from src.recordings.views import Views

ADAPTIVE = "adaptive"


class Steps:
    """What runs each level, made when it is first asked for, and warm."""

    def __init__(self, networks: Mapping[str, nn.Module], views: Views, how: Running):
        self.networks, self.views, self.how = networks, views, how
        self.lock = threading.Lock()
        self.made: dict[Level, Step] = {}

    def __call__(self, level: Level) -> Step:
        """Return the step of a level; raises ValueError where the views are not there."""
        with self.lock:
            if level not in self.made:
                places = quality.positions(level.views, self.views.positions)
                network = self.networks[level.network]
                self.made[level] = Step(network, self.views.only(places), self.how)
            return self.made[level]


class Controls:
    """Chooses for `reconstruction` among `networks`, from the smallest to the largest."""

    def __init__(
        self,
        reconstruction: Reconstruction,
        networks: Mapping[str, nn.Module],
        places: Sequence[tuple[int, int]],
        *,
        period_s: float,
        room: int,
    ):
        self.reconstruction, self.period_s, self.room = reconstruction, period_s, room
        self.counts = {
            name: quality.choices(getattr(network, "views", None), places)
            for name, network in networks.items()
        }
        self.chosen: dict[str, int | str] = {}

    def offered(self) -> dict[str, list[int | str]]:
        """Return, for each network, the numbers of views it can be given."""
        return {
            name: [*counts, *([ADAPTIVE] if len(self._ladder(name)) > 1 else [])]
            for name, counts in self.counts.items()
        }

    def choose(self, network: str, views: int | str) -> None:
        """Run `network` on `views`, or `adaptive`; raises ValueError for what is not offered."""
        offered = self.offered()
        if network not in offered:
            raise ValueError(f"network must be one of {', '.join(offered)}, got {network}")
        if views not in offered[network]:
            raise ValueError(f"views_used must be in {offered[network]}, got {views}")
        if views != ADAPTIVE:
            choice = Choice(Level(network, int(views)))
        else:
            ladder = self._ladder(network)
            shedding = Shedding(ladder, period_s=self.period_s, room=self.room)
            choice = Choice(ladder[0], shedding)
        self.reconstruction.choose(choice)
        self.chosen = {"network": network, "views": views}

    def _ladder(self, network: str) -> list[Level]:
        names = list(self.counts)
        smaller = names[: names.index(network)][::-1]
        return quality.ladder([network, *smaller], self.counts)
