"""A clip of shapes that are drawn where their truth says, by any part of a pixel."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray

from src.sim import noise
from src.sim.scenes.photographs import Clip, check_frames

FASTEST = 20_000.0  # px/s, beyond the dart of the paper; and turns/s
Drawing = Callable[[float], tuple[NDArray, NDArray, tuple[float, float]]]


class Target(ABC):
    """Bright shapes on a dark ground, grey levels 0.5 (1 -+ `contrast`).

    Where and when a clip starts is drawn from (seed, split, index); sizes and speeds are given.
    """

    def __init__(
        self,
        *,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
        split: str = "train",
        seed: int = 0,
        contrast: float = 0.8,
    ):
        check_frames(height, width, frames, fps, split)
        check_range("contrast", contrast, 0.0, 1.0)
        self.split, self.seed, self.contrast = split, seed, contrast
        self.height, self.width, self.side = height, width, min(height, width)
        self.centre = (width - 1) / 2, (height - 1) / 2
        self.fps, self.times = fps, np.arange(frames) / fps
        self.x, self.y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))

    def clip(self, index: int) -> Clip:
        """Return clip `index`; its motion is a function of time in seconds."""
        kind = type(self).__name__
        rng = np.random.default_rng(noise.key(self.seed, self.split, kind, index))
        draw = self.drawing(rng)
        shapes, _, path = zip(*(draw(time) for time in self.times), strict=True)
        frames = (0.5 + self.contrast * (np.stack(shapes) - 0.5)).astype(np.float32)
        truth = torch.tensor(path, dtype=torch.float32)
        return Clip(torch.from_numpy(frames), self.fps, f"{kind}-{index}", truth)

    @abstractmethod
    def drawing(self, rng: np.random.Generator) -> Drawing:
        """Return the function from a time in seconds to brightness (h, w) in [0, 1], 0 where the
        ground is seen, the share (h, w) of each pixel that the shape covers, and truth.
        """

    def around(self, x: float, y: float) -> tuple[NDArray, NDArray]:
        """Return every pixel's coordinates as seen from (x, y)."""
        return self.x - x, self.y - y


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise ValueError for a value of `scene.name` outside [low, high], or nan."""
    if not low <= value <= high:
        raise ValueError(f"scene.{name} must be in [{low:.3g}, {high:.3g}], got {value}")
