"""From windows to pictures: the thread of the network, and which network it is."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float

from src.live_view.backlog import Backlog
from src.live_view.levels import Level, Shedding
from src.live_view.meters import Meters
from src.live_view.screen import Screen
from src.live_view.step import Step

FADE_S = 0.2  # of recorded time, in which one network's picture gives way to another's


@dataclass(frozen=True)
class Choice:
    """A level to run; with `shedding`, the level that this says, window by window."""

    level: Level
    shedding: Shedding | None = None


class Reconstruction:
    """Runs `steps(level)` on the windows of `backlog` and shows the pictures on `screen`."""

    def __init__(
        self, backlog: Backlog, screen: Screen, meters: Meters, steps: Callable[[Level], Step]
    ):
        self.backlog, self.screen, self.meters, self.steps = backlog, screen, meters, steps
        self.choice: Choice | None = None
        self.level: Level | None = None  # that runs now
        self.step: Step | None = None
        self.picture: np.ndarray | None = None  # shown last
        self.old: np.ndarray | None = None  # shown last before the switch that is faded over
        self.began_us: float | None = None  # recorded time of that switch

    def choose(self, choice: Choice) -> None:
        """Run `choice` from the next window on; its steps are built here, in the caller's time."""
        for level in choice.shedding.levels if choice.shedding else [choice.level]:
            self.steps(level)
        self.choice = choice

    def run(self, stopped: threading.Event) -> None:
        """Reconstruct until `stopped`."""
        while not stopped.is_set():
            window = self.backlog.get(0.1)
            if window is None:
                continue
            start, choice = time.perf_counter(), self.choice
            shedding = choice.shedding
            self._switch(shedding.level if shedding else choice.level)
            if window.fresh:
                self.step.reset()
            self.screen.show(self._faded(self.step.step(window), window.end_us))
            done = time.perf_counter()
            self.meters.spent("network", done - start)
            self.meters.frame(done - window.due, len(window.events))
            if shedding:
                shedding.after(done - start, len(self.backlog), done)

    def _switch(self, level: Level) -> None:
        """Run another level from here on; it starts anew, behind the last picture."""
        if level == self.level:
            return
        self.level, self.step = level, self.steps(level)
        self.step.reset()
        self.old, self.began_us = self.picture, None

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
