"""Pre-simulated turbulence cache: what every view sees of a fixed set of clips, simulated once.

What turbulence does to a clip is slow to compute and stays the same; sensor, crop and augmentation
are fast and drawn anew for every sample (cached_pipeline.py).  Clip i is a function of the config
and of i, so it does not matter which process simulates it.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim.pipeline import ClipParameters, Pipeline, crop_frames

GIB = 2**30


class CachedClip(NamedTuple):
    """`views` (views, frames, h, w), what the optics put on the sensor, light; `clean` (frames, h,
    w), code values; both float16; `metadata`: name, fps and the record of the turbulence.
    """

    views: Float[Tensor, "views frames h w"]
    clean: Float[Tensor, "frames h w"]
    metadata: dict[str, Any]


@dataclass(frozen=True)
class CachedDraw(ClipParameters):
    """A draw out of a cache: `frames` of clip `index`, in this order; view k of the sample is view
    `view_order[k]` of the cache.
    """

    index: int
    frames: range
    view_order: tuple[int, ...]
    record: dict[str, Any]


class ClipCache(ABC):
    """`clips` clips of `source`, each of `frames` frames of `source.crop` pixels square.

    `gib`: the memory they may take together.  Raises ValueError where they would take more.
    """

    def __init__(self, source: Pipeline, *, clips: int, frames: int, gib: float):
        assert isinstance(source.crop, int)
        self.source, self.clips, self.frames = source, clips, frames
        self.clip_bytes = 2 * (source.optics.views + 1) * frames * source.crop**2
        size = clips * self.clip_bytes / GIB
        if not size <= gib:
            raise ValueError(
                f"data.cache_gib must be >= {size:.2f} for data.cache_clips={clips}, "
                f"{self.clip_bytes / 2**20:.1f} MiB a clip, got {gib}"
            )

    def missing(self) -> list[int]:
        """Return the numbers of the clips that are not in the cache yet."""
        return [index for index in range(self.clips) if not self.has(index)]

    @abstractmethod
    def has(self, index: int) -> bool:
        """Return whether clip `index` is in the cache."""

    @abstractmethod
    def store(self, index: int, clip: CachedClip) -> None:
        """Store clip `index`; raises OSError where there is no room for it."""

    @abstractmethod
    def clip(self, index: int) -> CachedClip:
        """Return clip `index`, simulated and stored first if it is missing."""

    @abstractmethod
    def read_views(
        self, draws: Sequence[CachedDraw], device: torch.device | str
    ) -> Float[Tensor, "n views frames h w"]:
        """Return what the views of `draws`, of one crop size, see: light, float16."""


class DeviceClipCache(ClipCache):
    """A cache in the memory of `device` ("cuda", "cpu"), which is taken with the first clip."""

    def __init__(self, source: Pipeline, *, device: torch.device | str, **size: Any):
        super().__init__(source, **size)
        self.device = device
        self.clear()

    def clear(self) -> None:
        """Give the memory back; all clips are missing again."""
        self.metadata: dict[int, dict[str, Any]] = {}
        self.views = self.clean = torch.empty(0)

    def has(self, index: int) -> bool:
        return index in self.metadata

    def store(self, index: int, clip: CachedClip) -> None:
        if not len(self.views):
            self.views, self.clean = (
                torch.empty((self.clips, *part.shape), dtype=torch.float16, device=self.device)
                for part in clip[:2]
            )
        self.views[index].copy_(clip.views)
        self.clean[index].copy_(clip.clean)
        self.metadata[index] = dict(clip.metadata)

    def clip(self, index: int) -> CachedClip:
        if not self.has(index):
            self.store(index, simulate_clip(self.source, index, self.device))
        return CachedClip(self.views[index], self.clean[index], self.metadata[index])

    def read_views(
        self, draws: Sequence[CachedDraw], device: torch.device | str
    ) -> Float[Tensor, "n views frames h w"]:
        corners = torch.tensor([draw.crop[:2] for draw in draws]).T[..., None]
        rows, columns = corners + torch.arange(draws[0].crop[2])
        places = (
            torch.tensor([draw.index for draw in draws])[:, None, None, None, None],
            torch.tensor([draw.view_order for draw in draws])[:, :, None, None, None],
            torch.tensor([list(draw.frames) for draw in draws])[:, None, :, None, None],
            rows[:, None, None, :, None],
            columns[:, None, None, None, :],
        )  # one gather for the batch
        return self.views[tuple(place.to(self.device) for place in places)].to(device)


def simulate_clip(source: Pipeline, index: int, device: torch.device | str) -> CachedClip:
    """Return clip `index` of `source`, simulated on `device`."""
    draw = source.draw(index)
    return CachedClip(
        source.render_views([draw], device)[0].half().contiguous(),
        crop_frames(draw.clip.frames, draw.crop).half().contiguous(),
        clip_metadata(source, draw),
    )


def clip_metadata(source: Pipeline, draw: ClipParameters) -> dict[str, Any]:
    """Return what is stored of a clip beside its frames."""
    return {"name": draw.clip.name, "fps": draw.clip.fps, "record": source.turbulence_record(draw)}


def select_frames(video: Tensor, frames: range) -> Tensor:
    """Return `frames`, neighbours forwards or backwards, of the first axis of a video."""
    part = video[min(frames) :][: len(frames)]
    return part.flip(0) if frames.step < 0 else part
