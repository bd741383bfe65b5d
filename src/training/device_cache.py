"""The pre-simulated turbulence cache in a device's memory, out of which batches are gathered."""

import json
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim.pipeline import Pipeline
from src.training.cache_drawing import facts_of

GIB = 2**30


class DeviceCache:
    """`clips` clips of what `source` shows, each of `frames` frames of `source.crop` pixels square.

    float16 on `device` ("cuda", "cpu"): `views` (clips, views, frames, h, w), what the optics put
    on the sensor, light, and `clean` (clips, frames, h, w), code values; nothing on a disk.  Memory
    is taken with the first clip that is kept.  `gib`: how much it may be.  Raises ValueError,
    naming the key, where it would be more.
    """

    def __init__(
        self, source: Pipeline, *, clips: int, frames: int, gib: float, device: torch.device | str
    ):
        self.source, self.clips, self.frames, self.device = source, clips, frames, device
        self.bytes = 2 * (source.optics.views + 1) * frames * source.crop**2
        full = clips * self.bytes / GIB
        if not full <= gib:
            raise ValueError(
                f"data.bank_gib must be >= {full:.2f} for data.bank={clips}, "
                f"{self.bytes / 2**20:.1f} MiB a clip, got {gib}"
            )
        self.facts: dict[int, dict] = {}
        self.views = self.clean = torch.empty(0)

    def missing(self) -> list[int]:
        """Return the clips that are not there yet."""
        return [index for index in range(self.clips) if index not in self.facts]

    def limit(self, clips: int) -> None:
        """Let samples be of the first `clips` clips only; ValueError where there are fewer."""
        if not 1 <= clips <= self.clips:
            raise ValueError(f"data.bank must be in 1..{self.clips} here, got {clips}")
        self.clips = clips

    def keep(
        self,
        index: int,
        views: Float[Tensor, "views frames h w"],
        clean: Float[Tensor, "frames h w"],
        facts: Mapping[str, Any],
    ) -> None:
        """Store clip `index`; `facts`: name, fps and the record of its air."""
        if not len(self.views):
            rows = {"dtype": torch.float16, "device": self.device}
            self.views = torch.empty(self.clips, *views.shape, **rows)
            self.clean = torch.empty(self.clips, *clean.shape, **rows)
        self.views[index].copy_(views)
        self.clean[index].copy_(clean)
        self.facts[index] = dict(facts)

    def clip(self, index: int) -> dict:
        """Return clip `index`, made if it is not there: its `views`, `clean` and `facts`, JSON."""
        if index not in self.facts:
            self.keep(index, *simulated(self.source, index, self.device))
        facts = json.dumps(self.facts[index])
        return {"views": self.views[index], "clean": self.clean[index], "facts": facts}

    def gather(
        self,
        clips: Int[Tensor, " n"],
        order: Int[Tensor, "n views"],
        frames: Int[Tensor, "n frames"],
        corners: Int[Tensor, "n 2"],
        side: int,
    ) -> Float[Tensor, "n views frames side side"]:
        """Return the `frames` of the views in `order`, squares of `side` pixels below and right of
        `corners` (row, column), float16, all clips in one operator.
        """
        places = (part.to(self.device) for part in (clips, order, frames, corners))
        clips, order, frames, corners = places
        along = torch.arange(side, device=self.device)
        rows, columns = (corners[:, axis, None] + along for axis in (0, 1))
        return self.views[
            clips[:, None, None, None, None], order[:, :, None, None, None],
            frames[:, None, :, None, None], rows[:, None, None, :, None],
            columns[:, None, None, None, :],
        ]  # fmt: skip

    def release(self) -> None:
        """Give the memory back; all clips are missing again."""
        self.facts, self.views, self.clean = {}, torch.empty(0), torch.empty(0)


def simulated(
    source: Pipeline, index: int, device: torch.device | str
) -> tuple[Float[Tensor, "views frames h w"], Float[Tensor, "frames h w"], dict]:
    """Return what every view sees of clip `index` and the clean clip, float16, and its facts."""
    draw = source.draw(index)
    top, left, height, width = draw.crop
    clean = draw.clip.frames[:, top : top + height, left : left + width].half().contiguous()
    return source.views(draw, device)[0].half(), clean, facts_of(source, draw)
