"""Pre-simulated turbulence cache: what every view sees of a fixed set of clips, simulated once.

Sensor, crop and augmentation are drawn anew for every sample (CachedPipeline).  Clip i is a
function of the config and of i, so it does not matter which process simulates it.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, cast

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics
from src.sim.pipeline import ClipParameters, Pipeline, crop_frames
from src.sim.scenes.clip import Clip
from src.sim.sensor.sensor import Sensor
from src.sim.turbulence.contract import Crop

GIB = 2**30
FIRST_CLIPS, SAMPLES_PER_CLIP = 8, 4  # sample n is of one of the first 8 + n / 4 clips
CROP_STEP = 16  # pixels between two sides of a range of crops


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
    def clip(self, index: int) -> CachedClip:
        """Return clip `index`, simulated and stored first if it is missing."""

    def read_views(
        self, draws: Sequence[CachedDraw], device: torch.device | str
    ) -> Float[Tensor, "n views frames h w"]:
        """Return what the views of `draws`, of one crop size, see: light, float16."""
        parts = []
        for draw in draws:
            crop = crop_frames(self.clip(draw.index).views, draw.crop)
            parts.append(select_frames(crop, draw.frames, dim=1)[list(draw.view_order)])
        return torch.stack(parts).to(device)


class DeviceClipCache(ClipCache):
    """A cache in the memory of `device` ("cuda", "cpu"), which is taken with the first clip."""

    def __init__(self, source: Pipeline, *, device: torch.device | str, **size: Any):
        super().__init__(source, **size)
        self.device = device
        self.clear()

    def clear(self) -> None:
        """Give the memory back; all clips are missing again."""
        self.renew_from(iter(()))
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

    def renew_from(self, clips: Iterator[CachedClip]) -> None:
        """Let the next of `clips` take the place of the oldest, each time that views are read."""
        self.new_clips, self.renewed = clips, 0

    def read_views(
        self, draws: Sequence[CachedDraw], device: torch.device | str
    ) -> Float[Tensor, "n views frames h w"]:
        views = super().read_views(draws, device)
        if (clip := next(self.new_clips, None)) is not None:
            self.store(self.renewed % self.clips, clip)
            self.renewed += 1
        return views

    def clip(self, index: int) -> CachedClip:
        if not self.has(index):
            self.store(index, simulate_clip(self.source, index, self.device))
        return CachedClip(self.views[index], self.clean[index], self.metadata[index])


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


def select_frames(video: Tensor, frames: range, dim: int = 0) -> Tensor:
    """Return `frames`, neighbours forwards or backwards, along `dim` of a video."""
    part = video.narrow(dim, min(frames), len(frames))
    return part.flip(dim) if frames.step < 0 else part


class CachedPipeline(Pipeline):
    """From a number to a sample whose turbulence comes from `cache`.

    Sample n is a function of (config, n), whatever the cache holds already: it is of one of the
    first FIRST_CLIPS + n / SAMPLES_PER_CLIP clips, the order in which a cache is filled; of fewer
    samples than SAMPLES_PER_CLIP for a clip, all clips see some.  Drawn by n as well: `windows`
    neighbouring windows, forwards or backwards, the crop, the order of the views (with
    `shuffle_views`, where their turbulence is independent), the sensor and its noise.  `clips`: how
    many different samples there are (None: all are).  `crop` = [low, high]: the side in pixels, a
    multiple of CROP_STEP above low, is the same for `batch_size` neighbouring numbers.  Raises
    ValueError for a range the clips do not hold and for `clips` that are no whole batches.
    """

    def __init__(
        self, cache: ClipCache, optics: Optics, sensor: Sensor, *, windows: int, bins: int = 5,
        crop: int | float | Sequence[float] | None = None, batch_size: int = 1,
        shuffle_views: bool = True, clips: int | None = None,
    ):  # fmt: skip
        source = cache.source
        super().__init__(
            source.scene, optics, source.turbulence, sensor, split=source.split, seed=source.seed,
            bins=bins, substeps=source.substeps, crop=None if isinstance(crop, Sequence) else crop,
            random_crop=True, clips=clips, decodes_srgb=source.decodes_srgb,
        )  # fmt: skip
        self.shuffles_views = shuffle_views
        self.cache, self.frames = cache, windows * source.substeps + 1
        self.sides, self.batch_size = self._crop_sides(crop), batch_size
        if self.sides and clips is not None and clips % batch_size:
            allowed = f"a multiple of data.batch_size={batch_size} where data.crop is a range"
            raise ValueError(f"data.train_clips must be {allowed}, got {clips}")
        if self.frames > cache.frames:
            most = (cache.frames - 1) // source.substeps
            raise ValueError(f"data.windows must be <= data.cache_windows, {most}, got {windows}")
        positions = [tuple(place) for place in source.optics.positions or ()]
        self.cache_views = [positions.index(tuple(place)) for place in optics.positions or ()]

    @property
    def repeats_samples(self) -> bool:
        return self.clips is not None

    def clip_index(self, number: int) -> int:
        """Return which clip of the cache sample `number` is of."""
        key = noise.key(self.seed, self.split, "banked", number, "clip")
        share = noise.uniforms(key, 1)[0]
        each = min(SAMPLES_PER_CLIP, (self.clips or math.inf) / self.cache.clips)
        return int(share * min(self.cache.clips, FIRST_CLIPS + int(number / each)))

    def draw(self, number: int) -> CachedDraw:
        """Draw everything random about sample `number`; simulates its clip if it is missing."""
        number = number if self.clips is None else number % self.clips
        key = noise.key(self.seed, self.split, "banked", number)
        start, direction = noise.uniforms(key, 2)
        first, index = int(start * (self.cache.frames - self.frames + 1)), self.clip_index(number)
        frames = range(first, first + self.frames)[:: -1 if direction < 0.5 else 1]
        clip = self.cache.clip(index)
        clean = select_frames(clip.clean, frames).float()
        return CachedDraw(
            clip=Clip(clean, clip.metadata["fps"], clip.metadata["name"]),
            crop=self._draw_crop(number, clean.shape[-2:], noise.key(key, "crop")),
            turbulence=None,
            sensor=self.sensor.draw(key, pixel_seed=noise.key(key, "chip")),
            key=key,
            number=number,
            index=index,
            frames=frames,
            view_order=self._draw_view_order(noise.key(key, "order")),
            record={"cached_clip": index} | clip.metadata["record"],
        )

    def render_views(
        self, draws: Sequence[ClipParameters], device: torch.device | str = "cpu"
    ) -> Float[Tensor, "n views frames h w"]:
        return self.cache.read_views(cast(Sequence[CachedDraw], draws), device)

    def tilt(self, draw: ClipParameters) -> Tensor:
        draw, source = cast(CachedDraw, draw), self.cache.source
        tilt = source.tilt(source.draw(draw.index))[list(draw.view_order)]
        return select_frames(crop_frames(tilt, draw.crop), draw.frames, dim=1)

    def turbulence_record(self, draw: ClipParameters) -> dict:
        return cast(CachedDraw, draw).record

    def _crop_sides(self, crop: Any) -> list[int]:
        if not isinstance(crop, Sequence):
            return []
        most = self.cache.source.crop
        is_pair = len(crop) == 2 and all(type(side) is int for side in crop)
        if not is_pair or not 8 <= crop[0] <= crop[1] <= most:
            allowed = f"[low, high] in 8..{most} (data.cache_crop)"
            raise ValueError(f"data.crop must be {allowed}, got {list(crop)}")
        return list(range(crop[0], crop[1] + 1, CROP_STEP))

    def _draw_crop(self, number: int, size: Sequence[int], key: int) -> Crop:
        if not self.sides:
            return self._crop_box(size, key)
        batch = noise.key(self.seed, self.split, "side", number // self.batch_size)
        side = self.sides[int(noise.uniforms(batch, 1)[0] * len(self.sides))]
        (height, width), (top, left) = size, noise.uniforms(key, 2)
        return int(top * (height - side + 1)), int(left * (width - side + 1)), side, side

    def _draw_view_order(self, key: int) -> tuple[int, ...]:
        order: Sequence[int] = range(self.cache.source.optics.views)
        if self.shuffles_views:
            order = sorted(order, key=noise.uniforms(key, len(order)).__getitem__)
        return tuple(order[view] for view in self.cache_views)
