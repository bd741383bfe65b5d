"""How things move in a clip, and when: functions of time in seconds."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

MOVES, RESTS = (0.05, 0.4), (0.05, 0.3)  # s, how long a spell of motion and a rest last
STOPS = (0.05, 0.3)  # s, when a clip stops


class Motion:
    """Drift, sway, turn and zoom as functions of time."""

    def __init__(self, rng: np.random.Generator, speed: Sequence[float]):
        rate, heading = rng.uniform(*speed), rng.uniform(0, 2 * math.pi)
        self.drift = 0.6 * rate * np.array([math.cos(heading), math.sin(heading)])
        self.pace = 2 * math.pi * rng.uniform(0.3, 3.0, 4)  # rad/s of sway x, y, turn and zoom
        self.phase = rng.uniform(0, 2 * math.pi, 4)
        swing = np.array([0.4 * rate, 0.4 * rate, rng.uniform(0, 0.8), rng.uniform(0, 0.3)])
        self.size = swing / self.pace  # so that `swing` is the largest speed of each
        self.angle = rng.uniform(-0.4, 0.4)

    def stop(self) -> None:
        """Stay as it is at t = 0."""
        self.drift, self.size = 0 * self.drift, 0 * self.size

    def at(self, time: float) -> tuple[NDArray, float, float]:
        """Return the shift (x, y) in frame widths, the angle in rad and the logarithm of zoom."""
        wave = self.size * (np.sin(self.pace * time + self.phase) - np.sin(self.phase))
        return self.drift * time + wave[:2], self.angle + wave[2], wave[3]


class Tempo:
    """A clip's way through its motion: in spells with rests between, until it stops, or never."""

    def __init__(self, rng: np.random.Generator):
        self.kind = ("pauses", "stops", "never")[rng.integers(3)]
        self.moves, self.rests = rng.uniform(*MOVES), rng.uniform(*RESTS)
        self.phase = rng.uniform(0, self.moves + self.rests)
        self.stop = rng.uniform(*STOPS)

    def __call__(self, time: float) -> float:
        """Return how long the clip has moved by `time`, in seconds."""
        if self.kind == "never":
            return 0.0
        if self.kind == "stops":
            return min(time, self.stop)
        return self._moved(self.phase + time) - self._moved(self.phase)

    def _moved(self, time: float) -> float:
        spells, rest = divmod(time, self.moves + self.rests)
        return spells * self.moves + min(rest, self.moves)
