"""A camera that stands still: a photograph, and before it drawn targets that move."""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch

from src.sim import noise
from src.sim.checks import is_range
from src.sim.scenes.clip import Clip
from src.sim.scenes.moving_layers import render_frame
from src.sim.scenes.photographs import PhotographScene
from src.sim.scenes.targets import TARGETS, Canvas, DrawFunction, check_arguments

KINDS = tuple(name for name in TARGETS if name != "checkerboard")  # it hides what is behind
RANDOM_CENTRE = ("rotating_dot", "spinning_stripe", "spinning_disc")
WHOLE_NUMBERS = ("sectors", "dots")  # arguments
LEAST_CONTRAST = 0.15  # of a target, its bright grey level over its dim one


@dataclass(kw_only=True, eq=False)
class TargetsOnPhotographs(PhotographScene):
    """Clips of one to `max_targets` targets before a photograph that stands still.

    `kinds`: of each kind (src/sim/scenes/targets.py) that may be drawn the arguments, a number or a
    range [low, high] to draw it from, log-uniform, or uniform where the range begins with 0 or
    less.  A target's two grey levels are drawn.  Raises ValueError for an unknown kind and for an
    argument that it cannot have.
    """

    kinds: Mapping[str, Mapping[str, Any]]
    max_targets: int = 2

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.kinds or not set(self.kinds) <= set(KINDS):
            allowed = ", ".join(KINDS)
            raise ValueError(f"scene.kinds must be some of {allowed}, got {list(self.kinds)}")
        self.canvas = Canvas(self.size)
        self.ranges: dict[str, dict[str, Any]] = {}
        for kind, given in self.kinds.items():
            ranges = self.ranges.setdefault(kind, {})
            for name, value in (given or {}).items():
                ranges[name] = [value, value] if isinstance(value, int | float) else value
                if not is_range(ranges[name]):
                    allowed = "a number or [low, high]"
                    raise ValueError(f"scene.kinds.{kind}.{name} must be {allowed}, got {value}")
            for ends in product(*ranges.values()):
                one = dict(zip(ranges, ends, strict=True))
                check_arguments(kind, one, self.canvas, f"scene.kinds.{kind}")

    def clip(self, index: int) -> Clip:
        rng = np.random.default_rng(noise.key(self.seed, self.split, "on photographs", index))
        photo, pixels = self.read_random_photograph(rng)
        layer = self.background_layer(pixels, rng, (1.0, 1.0))
        background = render_frame([layer], 0.0, self.size)
        targets = [self._draw_target(rng) for _ in range(rng.integers(1, self.max_targets + 1))]
        frames = []
        for time in self.motion_times_s(rng.uniform() < self.paused_clip_share, rng):
            frame = background.copy()
            for draw, dim, bright in targets:
                shape, cover, _ = draw(time)
                frame += cover * (dim - frame) + (bright - dim) * shape
            frames.append(frame)
        clipped = torch.from_numpy(np.clip(np.stack(frames), 0, 1).astype(np.float32))
        name, source = f"targets-{photo.stem}-{index}", self.name_source(photo)
        return Clip(clipped, self.fps, name, source=source)

    def _draw_target(self, rng: np.random.Generator) -> tuple[DrawFunction, float, float]:
        """Return a target's drawing, and the grey levels it has where it is dim and bright."""
        kind = list(self.ranges)[rng.integers(len(self.ranges))]
        arguments = {name: _draw(rng, name, *ends) for name, ends in self.ranges[kind].items()}
        canvas = copy(self.canvas)
        if kind in RANDOM_CENTRE:
            canvas.centre = tuple(rng.uniform(0.1, 0.9, 2) * (self.width, self.height))
        dim = rng.uniform(0.0, 1.0 - LEAST_CONTRAST)
        draw = TARGETS[kind](canvas, rng, **arguments)
        return draw, dim, rng.uniform(dim + LEAST_CONTRAST, 1.0)


def _draw(rng: np.random.Generator, name: str, low: float, high: float) -> float:
    if name in WHOLE_NUMBERS:
        return int(rng.integers(int(low), int(high) + 1))
    share = rng.uniform()
    return low * (high / low) ** share if low > 0 else low + (high - low) * share
