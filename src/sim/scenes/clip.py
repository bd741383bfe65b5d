"""Clean clips: what a scene makes, and the arguments that all scenes share."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.checks import check_in_range, is_range
from src.sim.scenes.moving_layers import FASTEST_WIDTHS_PER_S

SPLITS = ("train", "val", "test")
RANGES = {  # of what scenes take; a share is one of the clips
    "height": (8, 16384),
    "width": (8, 16384),
    "frames": (2, math.inf),
    "contrast": (0, 1),
    "paused_clip_share": (0, 1),
    "static_camera_share": (0, 1),
    "flicker_share": (0, 1),
    "max_cutouts": (0, 100),
    "max_targets": (1, 100),
}
WHOLE = ("height", "width", "frames", "max_cutouts", "max_targets")
INTERVALS = {  # what ranges of numbers are above, and up to
    "photo_px_per_px": (0, 100),
    "speed_widths_per_s": (0, FASTEST_WIDTHS_PER_S),
    "cutout_widths": (0.001, 100),
}


@dataclass(frozen=True)
class Clip:
    """`frames` (frames, h, w) float32 in [0, 1], code values; `path_px`: the path (frames, 2) of a
    known target's centre (x, y), where there is one; `illumination`: the factor in (0, 1] that a
    flickering lamp puts on the light of each frame, which `frames`, the ground truth, are without;
    `source`: which photograph (its path below `scene.root`, without suffix) or video it shows;
    other clips may show it, too.
    """

    frames: Float[Tensor, "frames h w"]
    fps: float
    name: str
    path_px: Float[Tensor, "frames 2"] | None = None
    illumination: Float[Tensor, " frames #h #w"] | None = None
    source: str = ""


@runtime_checkable
class Scene(Protocol):
    """Where clean clips come from; the class is given `split`, `seed`, `frames` and `fps` beside
    the values of the config."""

    def clip(self, index: int) -> Clip:
        """Return clip `index`, a function of `index` and the arguments of the class alone."""


@dataclass(kw_only=True, eq=False)
class SceneBase:
    """The arguments of every scene: size in pixels, number and rate of frames, split and seed.

    Raises ValueError for an argument that is outside its range, also for those of other scenes
    that RANGES and INTERVALS hold.
    """

    height: int = 256
    width: int = 256
    frames: int = 41
    fps: float = 120.0
    split: str = "train"
    seed: int = 0

    def __post_init__(self) -> None:
        check_split(self.split)
        if not 0 < self.fps < math.inf:
            raise ValueError(f"fps must be > 0, got {self.fps}")
        given = vars(self)
        for name in RANGES.keys() & given:
            check_in_range(f"scene.{name}", given[name], *RANGES[name])
            if name in WHOLE and not isinstance(given[name], Integral):
                raise ValueError(f"scene.{name} must be a whole number, got {given[name]}")
        for name in INTERVALS.keys() & given:
            ends, (above, most) = given[name], INTERVALS[name]
            if not (is_range(ends) and above < ends[0] and ends[1] <= most):
                allowed = f"a range {above} < low <= high <= {most:g}"
                raise ValueError(f"scene.{name} must be {allowed}, got {ends}")
        self.size = self.height, self.width
        self.times_s = np.arange(self.frames) / self.fps


class FrameRateMixture:
    """Scenes that differ in frame rate: clip k is that of one of them, drawn for each clip."""

    def __init__(self, scenes: Sequence[Scene], split: str = "train", seed: int = 0):
        self.scenes, self._key = list(scenes), noise.key(seed, split, "rate")

    def clip(self, index: int) -> Clip:
        draw = float(noise.uniform(self._key, torch.tensor(index)))
        return self.scenes[int(draw * len(self.scenes))].clip(index)


def check_split(split: str) -> None:
    """Raise ValueError for a split that is none."""
    if split not in SPLITS:
        raise ValueError(f"split must be one of {', '.join(SPLITS)}, got {split}")
