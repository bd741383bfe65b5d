"""A camera that stands still: a photograph, and before it drawn targets that move."""

import math
from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np
import torch

from src.sim import noise
from src.sim.scenes.drawing import Drawing
from src.sim.scenes.motion import Tempo
from src.sim.scenes.photo_files import Root, only_for_training, photographs, read
from src.sim.scenes.photo_layers import render
from src.sim.scenes.photographs import Clip, background, check_frames, check_share
from src.sim.scenes.targets import KINDS

ANYWHERE = ("rotating_dot", "spinning_stripe", "spinning_disc")  # their centre is drawn, too
COUNTS = ("sectors", "dots")  # arguments that are whole numbers
LEAST_CONTRAST = 0.15  # of a target, its bright grey level over its dim one


class TargetsOnPhotographs:
    """Clips of one to `targets` targets before a photograph that stands still.

    `kinds`: of each kind (src/sim/scenes/targets.py) that may be drawn the arguments, a number or a
    range [low, high] to draw it from, log-uniform, or uniform where the range begins with 0 or
    less.
    A target's two grey levels are drawn.  `root`, `train_root`, `zoom`, `rest`: as in Photographs.
    Raises ValueError for an unknown kind and for an argument that it cannot have.
    """

    def __init__(
        self,
        kinds: Mapping[str, Mapping[str, Any]],
        *,
        root: Root = None,
        train_root: Root = None,
        split: str = "train",
        seed: int = 0,
        height: int = 256,
        width: int = 256,
        frames: int = 41,
        fps: float = 120.0,
        targets: int = 2,
        zoom: Sequence[float] = (0.9, 1.6),
        rest: float = 0.0,
    ):
        check_frames(height, width, frames, fps, split)
        allowed = [name for name in KINDS if name != "checkerboard"]  # it hides what is behind
        if not kinds or not set(kinds) <= set(allowed):
            raise ValueError(f"scene.kinds must be some of {', '.join(allowed)}, got {list(kinds)}")
        if targets < 1:
            raise ValueError(f"scene.targets must be >= 1, got {targets}")
        if not 0 < zoom[0] <= zoom[1] < math.inf:
            raise ValueError(f"scene.zoom must be a range 0 < low <= high, got {list(zoom)}")
        check_share("rest", rest)
        self.photos = photographs(root, split)
        if split == "train":
            self.photos += only_for_training(train_root, root)
        self.frame = {"height": height, "width": width, "frames": frames, "fps": fps}
        self.kinds = {name: _ranges(name, kinds[name] or {}) for name in kinds}
        for name, ranges in self.kinds.items():
            for ends in product(*ranges.values()):
                KINDS[name](**self.frame, **dict(zip(ranges, ends, strict=True)))
        self.split, self.seed = split, seed
        self.targets, self.zoom, self.rest = targets, zoom, rest
        self.size, self.times, self.fps = (height, width), np.arange(frames) / fps, fps

    def clip(self, index: int) -> Clip:
        """Return clip `index`: a function of the seed, the split and the index."""
        rng = np.random.default_rng(noise.key(self.seed, self.split, "on photographs", index))
        photo = self.photos[rng.integers(len(self.photos))]
        still = background(read(photo), self.zoom, self.size, rng, (1.0, 1.0))
        ground = render([still], 0.0, self.size)
        drawn = [self._target(rng) for _ in range(rng.integers(1, self.targets + 1))]
        rests, tempo = rng.uniform() < self.rest, Tempo(rng)
        frames = []
        for time in map(tempo, self.times) if rests else self.times:
            frame = ground.copy()
            for draw, dim, bright in drawn:
                shape, cover, _ = draw(time)
                frame += cover * (dim - frame) + (bright - dim) * shape
            frames.append(frame)
        clipped = np.clip(np.stack(frames), 0, 1).astype(np.float32)
        return Clip(torch.from_numpy(clipped), self.fps, f"targets-{photo.stem}-{index}")

    def _target(self, rng: np.random.Generator) -> tuple[Drawing, float, float]:
        """Return a target's drawing, and the grey levels it has where it is dim and bright."""
        name = list(self.kinds)[rng.integers(len(self.kinds))]
        drawn = {key: _between(rng, key, *ends) for key, ends in self.kinds[name].items()}
        target = KINDS[name](**self.frame, **drawn)
        if name in ANYWHERE:
            target.centre = tuple(rng.uniform(0.1, 0.9, 2) * (self.size[1], self.size[0]))
        dim = rng.uniform(0.0, 1.0 - LEAST_CONTRAST)
        return target.drawing(rng), dim, rng.uniform(dim + LEAST_CONTRAST, 1.0)


def _ranges(kind: str, given: Mapping[str, Any]) -> dict[str, tuple[float, float]]:
    """Return every argument's range; raises ValueError for what is neither a number nor one."""
    ranges = {}
    for name, value in given.items():
        ends = [value, value] if isinstance(value, int | float) else value
        numbers = isinstance(ends, Sequence) and all(isinstance(end, int | float) for end in ends)
        if not numbers or len(ends) != 2 or not ends[0] <= ends[1]:
            allowed = "a number or [low, high]"
            raise ValueError(f"scene.kinds.{kind}.{name} must be {allowed}, got {value}")
        ranges[name] = (ends[0], ends[1])
    return ranges


def _between(rng: np.random.Generator, name: str, low: float, high: float) -> float:
    if name in COUNTS:
        return int(rng.integers(low, high + 1))
    share = rng.uniform()
    return low * (high / low) ** share if low > 0 else low + (high - low) * share
