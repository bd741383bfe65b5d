"""Samples from a bank of air: the clip and everything cheap about it is drawn anew for each."""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics
from src.sim.pipeline import Draw, Pipeline
from src.sim.scenes.photographs import Clip
from src.sim.sensor.contract import Sensor
from src.sim.turbulence.model import Crop
from src.training.bank import Bank
from src.training.device_cache import DeviceCache

FIRST, EACH = 8, 4  # sample n is of one of the first FIRST + n / EACH clips
STEP = 16  # pixels between two sides of a range of crops


@dataclass(frozen=True)
class Taken(Draw):
    """A draw out of a cache: clip `index`, from frame `first` on, `backwards` or not; the views are
    those of the cache in `order`.
    """

    index: int
    first: int
    backwards: bool
    order: tuple[int, ...]
    record: dict


class Banked(Pipeline):
    """From a number to a sample whose air comes from `bank`, on a disk or in a device's memory.

    Sample n is a function of (config, n), whether the bank is full or empty: it is of one of the
    first FIRST + n / EACH clips, the order in which a bank is filled, and a clip that is not there
    is made; of fewer samples than EACH for a clip, all clips see some.  Drawn by n as well:
    `windows` windows on end and which way they run, the crop, which view shows which air, the
    sensor, its noise.  Airs go
    round where they are `independent` and the views all registered alike.  `clips`: how many
    different samples there are, n modulo `clips`; None: all are.  `crop` = [low, high]: the side in
    pixels, uniform over the multiples of STEP from low to high, is the same for `together` numbers
    on end, those of a batch.  Raises ValueError for a range the clips do not hold, and for `clips`
    that are no whole number of batches.
    """

    def __init__(
        self,
        bank: Bank | DeviceCache,
        optics: Optics,
        sensor: Sensor,
        *,
        windows: int,
        bins: int = 5,
        crop: int | float | Sequence[float] | None = None,
        together: int = 1,
        independent: bool = True,
        clips: int | None = None,
    ):
        source = bank.source
        light = {"input": "srgb" if source.decode else "linear"}
        super().__init__(
            source.scene, optics, source.turbulence, light, split=source.split, seed=source.seed,
            bins=bins, substeps=source.substeps, crop=None if isinstance(crop, Sequence) else crop,
            random_crop=True, clips=clips,
        )  # fmt: skip
        self.sensor = sensor
        self.exchangeable = independent and source.optics.misalignment_px == 0
        self.bank, self.frames = bank, windows * source.substeps + 1
        self.sides, self.together = self._sides(crop), together
        if self.sides and clips is not None and clips % together:
            raise ValueError(
                f"data.clips must be a multiple of data.batch_size={together} where data.crop is a "
                f"range, got {clips}"
            )
        if self.frames > bank.frames:
            most = (bank.frames - 1) // source.substeps
            raise ValueError(f"data.windows must be <= data.bank_windows, {most}, got {windows}")
        self.places = [source.optics.positions.index(position) for position in optics.positions]

    def index(self, number: int) -> int:
        """Return which clip of the bank sample `number` is of."""
        key = noise.key(self.seed, self.split, "banked", number, "clip")
        share = noise.uniforms(key, 1)[0]
        each = min(EACH, (self.clips or math.inf) / self.bank.clips)
        return int(share * min(self.bank.clips, FIRST + int(number / each)))

    def draw(self, number: int) -> Taken:
        """Draw everything random about sample `number`; makes its clip if it is not there."""
        number = number if self.clips is None else number % self.clips
        key = noise.key(self.seed, self.split, "banked", number)
        when, way = noise.uniforms(key, 2)
        index = self.index(number)
        clip = self.bank.clip(index)
        facts, first = json.loads(clip["facts"]), int(when * (self.bank.frames - self.frames + 1))
        clean = self._run(clip["clean"][first : first + self.frames], 0, way < 0.5).float()
        return Taken(
            clip=Clip(clean, facts["fps"], facts["name"]),
            crop=self._square(number, clean.shape[-2:], noise.key(key, "crop")),
            air=None,
            sensor=self.sensor.draw(key, seed=noise.key(key, "chip")),
            key=key,
            number=number,
            index=index,
            first=first,
            backwards=way < 0.5,
            order=self._order(noise.key(key, "order")),
            record={"bank": index} | facts["record"],
        )

    def views(self, draw: Taken, device: torch.device | str = "cpu") -> Tensor:
        """Return what every view's optics put on the sensor, (1, views, frames, h, w), light."""
        return self.batch_views([draw], device).float()

    def batch_views(self, draws: Sequence[Taken], device: torch.device | str = "cpu") -> Tensor:
        """Return what the views of all `draws`, of one crop size, put on the sensor, (n, views,
        frames, h, w), light, float16: out of a device's memory gathered at once.
        """
        if not isinstance(self.bank, DeviceCache):
            return torch.stack([self._read(draw) for draw in draws]).to(device)
        spans = [range(draw.first, draw.first + self.frames) for draw in draws]
        frames = [
            list(span[::-1] if draw.backwards else span)
            for span, draw in zip(spans, draws, strict=True)
        ]
        return self.bank.gather(
            torch.tensor([draw.index for draw in draws]),
            torch.tensor([draw.order for draw in draws]),
            torch.tensor(frames),
            torch.tensor([draw.crop[:2] for draw in draws]),
            draws[0].crop[2],
        )

    def _read(self, draw: Taken) -> Tensor:
        top, left, height, width = draw.crop
        frames = slice(draw.first, draw.first + self.frames)
        place = frames, slice(top, top + height), slice(left, left + width)
        views = self.bank.clip(draw.index)["views"]
        part = torch.stack([views[(view, *place)] for view in draw.order])
        return self._run(part, 1, draw.backwards)

    def tilt(self, draw: Taken) -> Tensor:
        """Return how far every view sees each pixel displaced, (views, frames, 2, h, w), pixels."""
        source = self.bank.source
        whole = source.tilt(source.draw(draw.index))[list(draw.order)]
        top, left, height, width = draw.crop
        part = whole[:, draw.first :][:, : self.frames, :, top : top + height, left : left + width]
        return self._run(part, 1, draw.backwards)

    def record(self, draw: Taken) -> dict:
        """Return what is known of the air of a clip."""
        return draw.record

    def _sides(self, crop: Any) -> list[int]:
        """Return the sides that are drawn from; none: one side for all, `crop`."""
        if not isinstance(crop, Sequence):
            return []
        most = self.bank.source.crop
        whole = len(crop) == 2 and all(type(side) is int for side in crop)
        if not whole or not 8 <= crop[0] <= crop[1] <= most:
            raise ValueError(
                f"data.crop must be [low, high] in 8..{most} (data.bank_crop), got {list(crop)}"
            )
        return list(range(crop[0], crop[1] + 1, STEP))

    def _square(self, number: int, size: Sequence[int], key: int) -> Crop:
        if not self.sides:
            return self._crop(size, key)
        batch = noise.key(self.seed, self.split, "side", number // self.together)
        side = self.sides[int(noise.uniforms(batch, 1)[0] * len(self.sides))]
        top, left = (
            int(u * (n - side + 1)) for u, n in zip(noise.uniforms(key, 2), size, strict=True)
        )
        return top, left, side, side

    def _order(self, key: int) -> tuple[int, ...]:
        """Return which view of the bank each view shows."""
        places = range(self.bank.source.optics.views)
        if self.exchangeable:
            chances = noise.uniforms(key, len(places))
            places = sorted(places, key=chances.__getitem__)
        return tuple(places[place] for place in self.places)

    @staticmethod
    def _run(frames: Tensor, axis: int, backwards: bool) -> Tensor:
        return frames.flip(axis) if backwards else frames
