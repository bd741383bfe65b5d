"""One window of events to a picture: a network, its views and its state; and which of them runs.

A network with a first layer that events can be added to one by one runs on lists of events, the
others on voxel grids.
"""

import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float

from src import COMMAND
from src.deploy.runtime import EventListRuntime, fastest_form, supports_event_lists
from src.live_view.live_windows import EventWindow
from src.models.network import EventToVideoNetwork
from src.recordings.event_windows import Window, WindowRule, build_window_rule, fill_window
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.files.event_file import EVENT
from src.recordings.reconstruction import (
    ReconstructionState,
    build_runnable_network,
    reconstruct_frames,
)
from src.recordings.sensor_lookup import SensorLookup, build_lookup
from src.recordings.views import Views
from src.sim.optics import Position, layout

VIEW_COUNTS = (1, 3, 5, 9)  # to choose from, where the light field has them
TRIAL_PX, TRIAL_PIXELS = 8, 16  # where a picture's first tile has its middle; some pixels there
Finish = Callable[[], Float[np.ndarray, "h w"]]


@dataclass(frozen=True)
class RunSettings:
    """As the keys of conf/live.yaml; `form` None: the fastest that is there."""

    fps: float
    bins: int = 5
    splat: str = "nearest"
    window_length: str | None = None
    form: str | None = None


class NetworkRunner:
    """`network` on `views`, window after window, as `src.reconstruct` runs it; warm when made.

    Raises ValueError for what it cannot run with.
    """

    def __init__(
        self, name: str, network: EventToVideoNetwork, views: Views, settings: RunSettings
    ):
        self.name, self.views, fps = name, views, settings.fps
        length = settings.window_length or ("frame" if network.uses_window_length else "trained")
        if length == "growing":  # at rates that no machine reaches live
            raise ValueError(
                f"window_length must be frame or trained for `{COMMAND}live`, got growing"
            )
        self.frames_per_window = build_window_rule(length, fps=fps).frames_per_window
        form = settings.form or (fastest_form() if supports_event_lists(network) else "float32")
        self.network = build_runnable_network(network, form, "cpu", views, settings.bins)
        is_runtime = isinstance(self.network, EventListRuntime)
        self.rule = WindowRule(
            fps=fps, bins=settings.bins, splat=settings.splat, as_lists=is_runtime
        )
        self.lookup = build_lookup(views)
        # One without overlapping windows can begin a window while another is finished.
        self.is_pipelined = is_runtime and self.frames_per_window == 1
        self.recent: deque[EventWindow] = deque(maxlen=self.frames_per_window)
        for events in _list_trial_events(self.lookup):
            self.begin(EventWindow(0.0, 1e6 / fps, events), restart=True)()

    def begin(self, window: EventWindow, *, restart: bool = False) -> Finish:
        """Do what the events of `window` ask for; return what gives the picture, in [0, 1], which
        may run in another thread, in order.  The first window has to `restart`: forget all before.
        """
        if restart:
            self.recent.clear()
        self.recent.append(window)
        start_us, events = self._start_us(), window.events
        if self.frames_per_window > 1:  # of the windows in between some may be dropped
            events = concatenate_events([one.events for one in self.recent])
            events = events[count_before(events, start_us) :]
        filled = fill_window(events, self.lookup, self.rule, start_us, window.end_us)
        if not self.is_pipelined or not isinstance(self.network, EventListRuntime):
            return partial(self._run, filled, restart)
        begun, runtime = None, self.network
        if filled.events and filled.event_list is not None:
            begun = runtime.begin(*filled.event_list, 0.0, filled.length_s)
        return partial(self._finish, runtime, filled, begun, restart)

    def _start_us(self) -> float:
        """Return where the network's window begins: where one of the recent windows does, to the
        last bit, unless that was dropped or there are too few."""
        newest = self.recent[-1]
        period_us = newest.end_us - newest.start_us
        start_us = newest.end_us - self.frames_per_window * period_us
        oldest_us = self.recent[0].start_us
        return oldest_us if abs(oldest_us - start_us) < period_us / 2 else start_us

    def _run(self, window: Window, restart: bool) -> Float[np.ndarray, "h w"]:
        if restart:
            self.state = ReconstructionState(self.frames_per_window)
        frames = reconstruct_frames([window], self.network, self.views.positions, self.state)
        return next(frames).picture

    def _finish(
        self, runtime: EventListRuntime, window: Window, begun: Any, restart: bool
    ) -> Float[np.ndarray, "h w"]:
        """Run the rest of the network on a window that was begun; None: all, unless it is still."""
        if restart:
            runtime.reset()
            self.picture = np.full(self.views.model, 0.5, np.float32)
        if begun is not None:
            self.picture = runtime.finish(begun).clip(0, 1)
        elif runtime.is_settled(runtime.state):
            runtime.advance_without_events(runtime.state, window.length_s)
        elif window.event_list is not None:  # empty: what begins a window can go on meanwhile
            self.picture = runtime.step(*window.event_list, 0.0, window.length_s).clip(0, 1)
        return self.picture


def _list_trial_events(lookup: SensorLookup) -> list[np.ndarray]:
    """Return windows of events to run on, so that nothing is compiled while windows wait: in one
    tile, for kernels on few tiles, and along a row, three times, for the network on whole maps."""
    off_tile = np.abs(lookup.model_xy - TRIAL_PX).max(-1)
    nearest = np.argsort(np.where(lookup.view == 0, off_tile, np.inf), axis=None)[:TRIAL_PIXELS]
    height, width = lookup.view.shape
    spot, row = np.zeros(10 * len(nearest), EVENT), np.zeros(1000, EVENT)
    spot["y"], spot["x"] = np.unravel_index(np.tile(nearest, 10), (height, width))
    row["x"], row["y"] = np.linspace(0, width - 1, len(row)), height // 2
    spot["p"] = row["p"] = 1
    return [spot, row, row, row]


class Controls:
    """What a visitor can choose: one of `networks`, on how many of `views`; `offered`: the numbers
    of views for each; `chosen`: what runs now, on `runner`; `preparing`: what is made ready."""

    def __init__(
        self, networks: Mapping[str, EventToVideoNetwork], views: Views, settings: RunSettings
    ):
        self.networks, self.views, self.settings = networks, views, settings
        self.offered = {
            name: offered_view_counts(network.views, views.positions)
            for name, network in networks.items()
        }
        self.chosen: dict[str, int | str] = {}
        self.preparing: dict[str, int | str] | None = None
        self.runner: NetworkRunner | None = None
        self.one_view_runner: NetworkRunner | None = None  # beside `runner`, to compare
        self.compares_one_view = False
        self.lock = threading.Lock()
        self.runners: dict[tuple[str, int], NetworkRunner] = {}

    def choose(self, network: str, views: int | str) -> None:
        """Run `network` on `views`, a number or `all`, from the next window on.

        Raises ValueError for what is not offered.
        """
        count = self.count_views(network, views)
        self.runner = self._make_runner(network, count)
        self.chosen = {"network": network, "views": count}
        self.compare_one_view(self.compares_one_view)

    def count_views(self, network: str, views: int | str) -> int:
        """Return the number of views, of a number or `all`; ValueError for what is not offered."""
        if network not in self.offered:
            raise ValueError(f"network must be one of {', '.join(self.offered)}, got {network}")
        counts = self.offered[network]
        if views != "all" and views not in counts:
            allowed = ", ".join(map(str, ["all", *counts]))
            raise ValueError(f"views_used must be one of {allowed} for {network}, got {views}")
        return max(counts) if views == "all" else int(views)

    def compare_one_view(self, wanted: bool) -> None:
        """Also run the network on the centre view, where it takes any number and has several."""
        network, views = str(self.chosen["network"]), self.chosen["views"]
        several = 1 in self.offered[network] and views != 1
        self.one_view_runner = self._make_runner(network, 1) if wanted and several else None
        self.compares_one_view = wanted

    def _make_runner(self, network: str, count: int) -> NetworkRunner:
        with self.lock:
            if (network, count) in self.runners:
                return self.runners[network, count]
            self.preparing = {"network": network, "views": count}
            try:
                used = self.views.select(positions_used(count, self.views.positions))
                runner = NetworkRunner(network, self.networks[network], used, self.settings)
            finally:
                self.preparing = None
            self.runners[network, count] = runner
            return runner


def offered_view_counts(network_views: int | None, positions: Sequence[Position]) -> list[int]:
    """Return how many of the views at `positions` a network can be given; `network_views`: the
    number it was made for, None: any."""
    if network_views is not None:
        return [network_views]
    counts = {count for count in VIEW_COUNTS if set(layout(count)) <= set(positions)}
    return sorted(counts | {len(positions)})


def positions_used(count: int, positions: Sequence[Position]) -> list[Position]:
    """Return which of `positions` are used: all, or those of the layout of `count` views.

    Raises ValueError where the light field has not got them.
    """
    if count == len(positions):
        return list(positions)
    used = list(layout(count))
    if not set(used) <= set(positions):
        raise ValueError(f"ckpt wants the views {used}, the recording has {list(positions)}")
    return used
