"""One window of events to a picture: a network, its views and its state.

A network with a first layer that events can be added to one by one runs on lists of events, the
others on voxel grids.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import nn

from src.live_view.cutter import EventWindow
from src.models import openvino_cpu
from src.models.runtime import Runtime, runs
from src.recordings import listed, stream
from src.recordings.files.formats import EVENT
from src.recordings.lookup import build
from src.recordings.views import Views


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

    Raises ValueError for what it cannot run with.
    """

    def __init__(self, network: nn.Module, views: Views, how: Running):
        self.views, self.how = views, how
        self.overlap = stream.overlap(how.span or stream.default_span(network), how.fps)
        form = how.form or fastest(network)
        self.network = listed.ready(network, form, "cpu", views, how.bins)
        self.rule = stream.Rule(
            fps=how.fps,
            bins=how.bins,
            splat=how.splat,
            unit=how.unit,
            grids=not isinstance(self.network, Runtime),
        )
        self.lookup = build(views)
        self._warm_up()

    def reset(self) -> None:
        """Forget every window so far."""
        self.carry = stream.Carry()
        self.recent: deque[np.ndarray] = deque(maxlen=self.overlap)

    def step(self, window: EventWindow) -> Float[np.ndarray, "h w"]:
        """Return the picture at the end of `window`, in [0, 1]."""
        begin = window.end_us - self.overlap * (window.end_us - window.start_us)
        filled = stream.filled(self._since(begin, window), self.lookup, self.rule, begin,
                               window.end_us)  # fmt: skip
        more = {"overlap": self.overlap, "carry": self.carry}
        if isinstance(self.network, Runtime):
            frames = listed.frames([filled], self.network, **more)
        else:
            places = self.views.positions
            frames = stream.frames([filled], self.network, positions=places, **more)
        return next(frames).picture

    def _since(self, begin_us: float, window: EventWindow) -> np.ndarray:
        """Return the events since `begin_us`; of the windows in between some may be dropped."""
        self.recent.append(window.events)
        if self.overlap == 1:
            return window.events
        events = np.concatenate(self.recent)
        return events[np.searchsorted(events["t"], begin_us) :]

    def _warm_up(self) -> None:
        """Run on a few events, so that nothing is compiled while windows wait."""
        height, width = self.views.sensor
        events = np.zeros(1000, EVENT)
        events["x"], events["y"] = np.linspace(0, width - 1, len(events)), height // 2
        events["p"] = 1
        self.reset()
        for _ in range(3):
            self.step(EventWindow(0.0, 1e6 / self.how.fps, events))
            self.recent.clear()
        self.reset()


def fastest(network: nn.Module) -> str:
    """Return the form in which `network` runs fastest on a CPU with what is installed."""
    if not runs(network):
        return "float32"
    return "openvino" if openvino_cpu.installed() else "bf16"
