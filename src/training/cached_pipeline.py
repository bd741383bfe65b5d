"""Samples from a pre-simulated turbulence cache: all that is fast is drawn anew for each."""

import math
from collections.abc import Sequence
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics
from src.sim.pipeline import ClipParameters, Pipeline
from src.sim.scenes.clip import Clip
from src.sim.sensor.sensor import Sensor
from src.sim.turbulence.contract import Crop
from src.training.clip_cache import CachedDraw, ClipCache, select_frames

FIRST_CLIPS, SAMPLES_PER_CLIP = 8, 4  # sample n is of one of the first 8 + n / 4 clips
CROP_STEP = 16  # pixels between two sides of a range of crops


class CachedPipeline(Pipeline):
    """From a number to a sample whose turbulence comes from `cache`.

    Sample n is a function of (config, n), whatever the cache holds already: it is of one of the
    first FIRST_CLIPS + n / SAMPLES_PER_CLIP clips, the order in which a cache is filled; of fewer
    samples than SAMPLES_PER_CLIP for a clip, all clips see some.  Drawn by n as well: `windows`
    neighbouring windows, forwards or backwards, the crop, the order of the views (where their
    turbulence is `independent` and all are registered alike), the sensor and its noise.  `clips`:
    how many different samples there are (None: all are).  `crop` = [low, high]: the side in pixels,
    a multiple of CROP_STEP above low, is the same for `batch_size` neighbouring numbers.  Raises
    ValueError for a range the clips do not hold and for `clips` that are no whole batches.
    """

    def __init__(
        self,
        cache: ClipCache,
        optics: Optics,
        sensor: Sensor,
        *,
        windows: int,
        bins: int = 5,
        crop: int | float | Sequence[float] | None = None,
        batch_size: int = 1,
        independent: bool = True,
        clips: int | None = None,
    ):
        source = cache.source
        super().__init__(
            source.scene, optics, source.turbulence, sensor, split=source.split, seed=source.seed,
            bins=bins, substeps=source.substeps, crop=None if isinstance(crop, Sequence) else crop,
            random_crop=True, clips=clips, decodes_srgb=source.decodes_srgb,
        )  # fmt: skip
        self.shuffles_views = independent and source.optics.homography_error_px == 0
        self.cache, self.frames = cache, windows * source.substeps + 1
        self.sides, self.batch_size = self._crop_sides(crop), batch_size
        if self.sides and clips is not None and clips % batch_size:
            raise ValueError(
                f"data.clips must be a multiple of data.batch_size={batch_size} where data.crop is "
                f"a range, got {clips}"
            )
        if self.frames > cache.frames:
            most = (cache.frames - 1) // source.substeps
            raise ValueError(f"data.windows must be <= data.cache_windows, {most}, got {windows}")
        positions = [tuple(place) for place in source.optics.positions or ()]
        self.cache_views = [positions.index(tuple(place)) for place in optics.positions or ()]

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
        top, left, height, width = draw.crop
        crop = tilt[..., top : top + height, left : left + width]
        return select_frames(crop.transpose(0, 1), draw.frames).transpose(0, 1)

    def turbulence_record(self, draw: ClipParameters) -> dict:
        return cast(CachedDraw, draw).record

    def _crop_sides(self, crop: Any) -> list[int]:
        if not isinstance(crop, Sequence):
            return []
        most = self.cache.source.crop
        is_pair = len(crop) == 2 and all(type(side) is int for side in crop)
        if not is_pair or not 8 <= crop[0] <= crop[1] <= most:
            raise ValueError(
                f"data.crop must be [low, high] in 8..{most} (data.cache_crop), got {list(crop)}"
            )
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
