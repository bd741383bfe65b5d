"""Several kinds of scenes in one, and light that flickers with the mains.

An event camera sees the flicker, the ground truth does not show it.  A lamp on alternating current
is brightest twice a period: at 100 Hz where the mains have 50 Hz, at 120 Hz where they have 60
(IEEE 1789-2015, which also defines percent flicker, here `depth`).
"""

import math
import re
from bisect import bisect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from src.sim import noise
from src.sim.checks import is_range
from src.sim.scenes.clip import SPLITS, Clip, SceneBase
from src.sim.scenes.footage import Footage
from src.sim.scenes.photo_files import Root

MAINS_HZ = (50.0, 60.0)
LEAST_FPS = 480.0  # at fewer than four frames a period a flicker of 120 Hz aliases
LAMP_WIDTHS = (0.15, 0.6)  # frame widths, how far a lamp that lights a part of the scene reaches


@dataclass(kw_only=True, eq=False)
class Mixture(SceneBase):
    """Clip `index` is that of one of `parts`, drawn by their shares.

    A part holds `scene`, a class of scenes with its own arguments filled in; `share`, any number
    from 0 on, 0 leaves it out; and `splits`, those that it serves (None: all).  `in_turn`: of
    validation and test clip k is of part k modulo their number, so that a few clips show all.
    `flicker_share`: of the clips whose light flickers with the mains, by a share out of
    `flicker_modulation_depth`; none does below 480 frames (windows times substeps) a second,
    where it would alias.  The parts' configs refer to `root`, `extra_train_root` and `video_root`.
    """

    parts: Mapping[str, Mapping[str, Any]]
    root: Root = None
    extra_train_root: Root = None
    video_root: str | None = None
    in_turn: bool = False
    flicker_share: float = 0.0
    flicker_modulation_depth: Sequence[float] = (0.05, 0.4)

    def __post_init__(self) -> None:
        super().__post_init__()
        depths = self.flicker_modulation_depth
        if not (is_range(depths) and depths[0] >= 0 and depths[1] < 1):
            allowed = "a range 0 <= low <= high < 1"
            raise ValueError(f"scene.flicker_modulation_depth must be {allowed}, got {depths}")
        served = {}
        for name, part in self.parts.items():
            share, splits = part["share"], part.get("splits") or SPLITS
            if not (isinstance(share, int | float) and 0 <= share < math.inf):
                raise ValueError(f"scene.parts.{name}.share must be >= 0, got {share}")
            if not set(splits) <= set(SPLITS):
                key, allowed = f"scene.parts.{name}.splits", ", ".join(SPLITS)
                raise ValueError(f"{key} must be some of {allowed}, got {splits}")
            if share > 0 and self.split in splits:
                served[name] = part
        if not served:
            raise ValueError(f"scene.parts must have a share > 0 for split={self.split}, got none")
        shared = {one.name: getattr(self, one.name) for one in fields(SceneBase)}
        self.names, self.scenes = list(served), []
        for name, part in served.items():
            with self._named_part(name):
                self.scenes.append(part["scene"](**shared))
        self.cumulative_shares = list(accumulate(part["share"] for part in served.values()))
        self.key = noise.key(self.seed, self.split, "mixture")

    def clip(self, index: int) -> Clip:
        draw = float(noise.uniform(self.key, torch.tensor(index)))
        place = bisect(self.cumulative_shares, draw * self.cumulative_shares[-1])
        if self.in_turn and self.split != "train":
            place = index % len(self.scenes)
        with self._named_part(self.names[place]):
            clip = self.scenes[place].clip(index)
        rng = np.random.default_rng(noise.key(self.key, "flicker", index))
        if clip.fps < LEAST_FPS or rng.uniform() >= self.flicker_share:
            return clip
        times_s = np.arange(len(clip.frames)) / clip.fps
        size, depth = tuple(clip.frames.shape[1:]), self.flicker_modulation_depth
        return replace(clip, illumination=draw_flicker(rng, times_s, size, depth))

    @contextmanager
    def _named_part(self, name: str) -> Iterator[None]:
        """Name, in a ValueError of a part, the key that was given."""
        try:
            yield
        except ValueError as error:
            scene = self.parts[name]["scene"]
            message, own = str(error), getattr(scene, "keywords", {})
            _, *keys = re.split(r"^scene\.(\w+)", message, maxsplit=1)
            if getattr(scene, "func", scene) is Footage and keys[:1] == ["root"]:
                message = f"scene.video_root{keys[1]}"
            elif keys and keys[0] in own.keys() - vars(self).keys():
                message = f"scene.parts.{name}.{message}"
            raise ValueError(message) from error


def draw_flicker(
    rng: np.random.Generator, times_s: NDArray, size: tuple[int, int], depths: Sequence[float]
) -> Float[Tensor, " frames #h #w"]:
    """Return the factor in (0, 1] that a lamp puts on the light at `times_s`.

    It goes as |sin| at the mains' frequency, of random phase, its percent flicker drawn from
    `depths`; every second lamp lights the whole frame of `size` (h, w), the others a smooth pool.
    """
    low, high = depths
    mains, depth = MAINS_HZ[rng.integers(2)], rng.uniform(low, high)
    wave = abs(np.sin(2 * math.pi * mains * times_s + rng.uniform(0, math.pi)))
    swing = 2 * depth / (1 + depth)  # from the highest, which is 1
    whole, centre, reach = rng.uniform() < 0.5, rng.uniform(0, 1, 2), rng.uniform(*LAMP_WIDTHS)
    height, width = size
    across = np.arange(width) / width - centre[0]
    down = (np.arange(height) - centre[1] * height) / width
    pool = np.exp(-(across**2 + down[:, None] ** 2) / (2 * reach**2))
    lit = np.ones((1, 1)) if whole else pool
    return torch.from_numpy((1 - swing * lit * (1 - wave)[:, None, None]).astype(np.float32))
