"""Several kinds of scenes in one: what a network should see of everything."""

from bisect import bisect
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

import numpy as np
import torch

from src.sim import noise
from src.sim.scenes.lamps import LEAST_RATE, flicker
from src.sim.scenes.photo_files import SPLITS, Root
from src.sim.scenes.photographs import Clip, check_share


class Mixture:
    """Clip `index` is that of one of `parts`, drawn by their shares.

    A part holds `scene`, a class of scenes with its own arguments filled in; `share`, any number
    from 0 on, 0 leaves it out; and `splits`, those that it serves (None: all).  `flicker`: share of
    the clips whose light flickers with the mains, by a percent flicker out of `flicker_depth`; none
    does below 480 frames (windows times substeps) a second, where it would alias.  `frame`: what
    all scenes are given.  `root`, `train_root` and `video` are there for the parts' configs to
    refer to.
    """

    def __init__(
        self,
        parts: Mapping[str, Mapping[str, Any]],
        *,
        split: str = "train",
        seed: int = 0,
        root: Root = None,
        train_root: Root = None,
        video: str | None = None,
        flicker: float = 0.0,
        flicker_depth: Sequence[float] = (0.05, 0.4),
        **frame: Any,
    ):
        check_share("flicker", flicker)
        if not 0 <= flicker_depth[0] <= flicker_depth[1] < 1:
            allowed = "a range 0 <= low <= high < 1"
            raise ValueError(f"scene.flicker_depth must be {allowed}, got {list(flicker_depth)}")
        chosen = {}
        for name, part in parts.items():
            share, splits = part["share"], part.get("splits") or SPLITS
            if not (isinstance(share, int | float) and 0 <= share < float("inf")):
                raise ValueError(f"scene.parts.{name}.share must be >= 0, got {share}")
            if not set(splits) <= set(SPLITS):
                allowed = ", ".join(SPLITS)
                raise ValueError(
                    f"scene.parts.{name}.splits must be some of {allowed}, got {splits}"
                )
            if share > 0 and split in splits:
                chosen[name] = (share, part["scene"])
        if not chosen:
            raise ValueError(f"scene.parts must have a share > 0 for split={split}, got none")
        self.scenes = [scene(split=split, seed=seed, **frame) for _, scene in chosen.values()]
        self.ends = list(accumulate(share for share, _ in chosen.values()))
        self.key = noise.key(seed, split, "mixture")
        self.flicker, self.flicker_depth = flicker, tuple(flicker_depth)

    def clip(self, index: int) -> Clip:
        """Return clip `index` of the part drawn for it."""
        place = float(noise.uniform(self.key, torch.tensor(index))) * self.ends[-1]
        clip = self.scenes[bisect(self.ends, place)].clip(index)
        return self._lit(clip, index) if clip.fps >= LEAST_RATE else clip

    def _lit(self, clip: Clip, index: int) -> Clip:
        """Return the clip under a lamp that flickers, if one is drawn for it."""
        rng = np.random.default_rng(noise.key(self.key, "flicker", index))
        if rng.uniform() >= self.flicker:
            return clip
        frames, *size = clip.frames.shape
        times = np.arange(frames) / clip.fps
        return replace(clip, lamp=flicker(rng, times, tuple(size), self.flicker_depth))
