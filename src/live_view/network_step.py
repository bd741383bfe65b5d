"""One window of events to a picture: a network, its views and its state.

A network with a first layer that events can be added to one by one runs on lists of events, the
others on voxel grids.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float
from torch import nn

from src.live_view.cutter import EventWindow
from src.models.runtime import Runtime, fastest, runs
from src.recordings import event_lists, stream
from src.recordings.files.event_arrays import joined, until
from src.recordings.files.formats import EVENT
from src.recordings.lookup import build
from src.recordings.views import Views

Finish = Callable[[], Float[np.ndarray, "h w"]]


@dataclass(frozen=True)
class Running:
    """How events are laid into a view, as in `stream.Rule`, and how the network runs.

    `form`: as of `src.reconstruct`; None: the fastest that is there.
    """

    fps: float
    bins: int = 5
    splat: str = "nearest"
    unit: str = "pixel"
    span: str | None = None
    form: str | None = None


class Step:
    """`network` on `views`, window after window, as `src.reconstruct` runs it; warm when made.

    The first window must be `fresh`.  Raises ValueError for what it cannot run with.
    """

    def __init__(self, network: nn.Module, views: Views, how: Running):
        self.views, self.how = views, how
        self.overlap = stream.overlap(how.span or stream.default_span(network), how.fps)
        form = how.form or (fastest() if runs(network) else "float32")
        self.network = event_lists.ready(network, form, "cpu", views, how.bins)
        listed = isinstance(self.network, Runtime)
        self.rule = stream.Rule(
            fps=how.fps, bins=how.bins, splat=how.splat, unit=how.unit, grids=not listed
        )
        self.lookup = build(views)
        # One that keeps no overlapping windows apart can begin one while another is finished.
        self.ahead = listed and self.overlap == 1
        self._warm_up()

    def begin(self, window: EventWindow, *, fresh: bool = False) -> Finish:
        """Do what the events of `window` ask for; return what gives the picture, in [0, 1], at its
        end.  That may run in another thread, window after window.  `fresh`: forget all before.
        """
        if fresh:
            self.recent.clear()
        begin = window.end_us - self.overlap * (window.end_us - window.start_us)
        events = self._since(begin, window)
        filled = stream.filled(events, self.lookup, self.rule, begin, window.end_us)
        if not self.ahead:
            return partial(self._stepped, filled, fresh)
        if fresh:
            self.network.front.reset()
        begun = self.network.begin(*filled.parts, 0.0, filled.seconds) if filled.events else None
        return partial(self._finished, begun, fresh)

    def _stepped(self, filled: stream.Window, fresh: bool) -> Float[np.ndarray, "h w"]:
        """Run the network on a window."""
        if fresh:
            self.carry = stream.Carry()
        more = {"overlap": self.overlap, "carry": self.carry}
        if isinstance(self.network, Runtime):
            frames = event_lists.frames([filled], self.network, **more)
        else:
            places = self.views.positions
            frames = stream.frames([filled], self.network, positions=places, **more)
        return next(frames).picture

    def _finished(self, begun: list[np.ndarray] | None, fresh: bool) -> Float[np.ndarray, "h w"]:
        """Run the rest of the network on a window that was begun; one without events holds."""
        if fresh:
            self.network.behind.reset()
            self.held = np.full(self.views.model, 0.5, np.float32)
        if begun is not None:
            self.held = self.network.finish(begun).clip(0, 1)
        return self.held

    def _since(self, begin_us: float, window: EventWindow) -> np.ndarray:
        """Return the events since `begin_us`; of the windows in between some may be dropped."""
        self.recent.append(window.events)
        if self.overlap == 1:
            return window.events
        events = joined(self.recent)
        return events[until(events, begin_us) :]

    def _warm_up(self) -> None:
        """Run on a few events, so that nothing is compiled while windows wait."""
        height, width = self.views.sensor
        events = np.zeros(1000, EVENT)
        events["x"], events["y"] = np.linspace(0, width - 1, len(events)), height // 2
        events["p"] = 1
        self.recent: deque[np.ndarray] = deque(maxlen=self.overlap)
        for _ in range(3):
            self.begin(EventWindow(0.0, 1e6 / self.how.fps, events), fresh=True)()
