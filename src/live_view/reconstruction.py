"""From windows to pictures: a thread for events, one for the network, and which network it is."""

import queue
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from src.live_view.backlog import Backlog
from src.live_view.cutter import EventWindow
from src.live_view.meters import Meters
from src.live_view.network_step import Finish, Step
from src.live_view.quality import Level, Shedding
from src.live_view.screen import Screen

FADE_S = 0.2  # of recorded time, in which one network's picture gives way to another's


@dataclass(frozen=True)
class Choice:
    """A level to run; with `shedding`, the level that this says, window by window."""

    level: Level
    shedding: Shedding | None = None


@dataclass(frozen=True)
class Begun:
    """A window half done: `finish` gives its picture; `switched`: another level than before."""

    window: EventWindow
    finish: Finish
    switched: bool
    taken_s: float
    shedding: Shedding | None


class Reconstruction:
    """Runs `steps(level)` on the windows of `backlog` and shows the pictures on `screen`."""

    def __init__(
        self, backlog: Backlog, screen: Screen, meters: Meters, steps: Callable[[Level], Step]
    ):
        self.backlog, self.screen, self.meters, self.steps = backlog, screen, meters, steps
        self.choice: Choice | None = None
        self.level: Level | None = None  # that runs now
        self.begun: queue.Queue[Begun] = queue.Queue(1)
        self.picture: np.ndarray | None = None  # shown last
        self.old: np.ndarray | None = None  # shown last before the switch that is faded over
        self.began_us: float | None = None  # recorded time of that switch

    def choose(self, choice: Choice) -> None:
        """Run `choice` from the next window on; its steps are built here, in the caller's time."""
        for level in choice.shedding.levels if choice.shedding else [choice.level]:
            self.steps(level)
        self.choice = choice

    def lay_events(self, stopped: threading.Event) -> None:
        """Look events up and lay them into the first layer, a window ahead, until `stopped`."""
        while not stopped.is_set():
            window = self.backlog.get(0.1)
            if window is None:
                continue
            start, choice = time.perf_counter(), self.choice
            level = choice.shedding.level if choice.shedding else choice.level
            switched, self.level = level != self.level, level
            finish = self.steps(level).begin(window, fresh=window.fresh or switched)
            taken = time.perf_counter() - start
            self.meters.spent("events", taken)
            self._hand_on(Begun(window, finish, switched, taken, choice.shedding), stopped)

    def _hand_on(self, begun: Begun, stopped: threading.Event) -> None:
        while not stopped.is_set():
            try:
                return self.begun.put(begun, timeout=0.1)
            except queue.Full:
                continue

    def run_network(self, stopped: threading.Event) -> None:
        """Run the network on what was begun, and show the pictures, until `stopped`."""
        while not stopped.is_set():
            try:
                begun = self.begun.get(timeout=0.1)
            except queue.Empty:
                continue
            start, window = time.perf_counter(), begun.window
            if begun.switched:  # it starts anew, behind the last picture
                self.old, self.began_us = self.picture, None
            self.screen.show(self._faded(begun.finish(), window.end_us))
            done = time.perf_counter()
            self.meters.spent("network", done - start)
            self.meters.frame(done - window.due, len(window.events))
            if begun.shedding:
                slower = max(begun.taken_s, done - start)
                begun.shedding.after(slower, len(self.backlog), done)

    def _faded(self, picture: Float[np.ndarray, "h w"], time_us: float) -> np.ndarray:
        """Return `picture`; for FADE_S after a switch, with what is left of the last one before."""
        if self.old is not None:
            self.began_us = time_us if self.began_us is None else self.began_us
            share = abs(time_us - self.began_us) * 1e-6 / FADE_S
            if share < 1:
                picture = cv2.addWeighted(picture, share, self.old, 1 - share, 0)
            else:
                self.old = None
        self.picture = picture
        return picture
