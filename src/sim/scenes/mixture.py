"""Several kinds of scenes in one: what a network should see of everything."""

from bisect import bisect
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Any

import torch

from src.sim import noise
from src.sim.scenes.photographs import SPLITS, Clip


class Mixture:
    """Clip `index` is that of one of `parts`, drawn by their shares.

    A part holds `scene`, a class of scenes with its own arguments filled in; `share`, any number
    from 0 on, 0 leaves it out; and `splits`, those that it serves (None: all).  `frame`: what all
    scenes are given.  `root` and `video` are there for the parts' configs to refer to.
    """

    def __init__(
        self,
        parts: Mapping[str, Mapping[str, Any]],
        *,
        split: str = "train",
        seed: int = 0,
        root: str | Sequence[str] | None = None,
        video: str | None = None,
        **frame: Any,
    ):
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

    def clip(self, index: int) -> Clip:
        """Return clip `index` of the part drawn for it."""
        place = float(noise.uniform(self.key, torch.tensor(index))) * self.ends[-1]
        return self.scenes[bisect(self.ends, place)].clip(index)
