"""Samples from a bank of air: the clip and everything cheap about it is drawn anew for each."""

import json
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics
from src.sim.pipeline import Draw, Pipeline
from src.sim.scenes.photographs import Clip
from src.sim.sensor.contract import Sensor
from src.training.bank import Bank

FIRST, EACH = 8, 4  # sample n is of one of the first FIRST + n / EACH clips


@dataclass(frozen=True)
class Taken(Draw):
    """A draw out of a bank: clip `index`, from frame `first` on, `backwards` or not; the views show
    those of the bank in `order`, `seen` (views, frames, h, w) in float16 and as it is stored.
    """

    index: int
    first: int
    backwards: bool
    order: tuple[int, ...]
    seen: Tensor
    record: dict


class Banked(Pipeline):
    """From a number to a sample whose air comes from `bank`.

    Sample n is a function of (config, n), whether the bank is full or empty: it is of one of the
    first FIRST + n / EACH clips, the order in which a bank is filled, and a clip that is not there
    is made; of fewer samples than EACH for a clip, all clips see some.  Drawn by n as well:
    `windows` windows on end and which way they run, the crop, which view shows which air, the
    sensor, its noise.  Airs go
    round where they are `independent` and the views all registered alike.  `clips`: how many
    different samples there are, n modulo `clips`; None: all are.
    """

    def __init__(
        self,
        bank: Bank,
        optics: Optics,
        sensor: Sensor,
        *,
        windows: int,
        bins: int = 5,
        crop: int | float | None = None,
        independent: bool = True,
        clips: int | None = None,
    ):
        source = bank.source
        light = {"input": "srgb" if source.decode else "linear"}
        super().__init__(
            source.scene, optics, source.turbulence, light, split=source.split, seed=source.seed,
            bins=bins, substeps=source.substeps, crop=crop, random_crop=True, clips=clips,
        )  # fmt: skip
        self.sensor = sensor
        self.exchangeable = independent and source.optics.misalignment_px == 0
        self.bank, self.frames = bank, windows * source.substeps + 1
        if self.frames > bank.frames:
            most = (bank.frames - 1) // source.substeps
            raise ValueError(f"data.windows must be <= data.bank_windows, {most}, got {windows}")
        self.places = [source.optics.positions.index(position) for position in optics.positions]

    def index(self, number: int) -> int:
        """Return which clip of the bank sample `number` is of."""
        key = noise.key(self.seed, self.split, "banked", number, "clip")
        share = float(noise.uniform(key, torch.tensor(0)))
        each = min(EACH, (self.clips or math.inf) / self.bank.clips)
        return int(share * min(self.bank.clips, FIRST + int(number / each)))

    def draw(self, number: int) -> Taken:
        """Draw everything random about sample `number`; makes its clip if it is not there."""
        number = number if self.clips is None else number % self.clips
        key = noise.key(self.seed, self.split, "banked", number)
        when, way = noise.uniform(key, torch.arange(2)).tolist()
        index = self.index(number)
        clip = self.bank.clip(index)
        facts, first = json.loads(clip["facts"]), int(when * (self.bank.frames - self.frames + 1))
        frames = slice(first, first + self.frames)
        clean = self._run(clip["clean"][frames], 0, way < 0.5)
        top, left, height, width = crop = self._crop(clean.shape[-2:], noise.key(key, "crop"))
        place = frames, slice(top, top + height), slice(left, left + width)
        order = self._order(noise.key(key, "order"))
        return Taken(
            clip=Clip(clean, facts["fps"], facts["name"]),
            crop=crop,
            air=None,
            sensor=self.sensor.draw(key, seed=noise.key(key, "chip")),
            key=key,
            number=number,
            index=index,
            first=first,
            backwards=way < 0.5,
            order=order,
            seen=torch.stack([clip["views"][(view, *place)] for view in order]),
            record={"bank": index} | facts["record"],
        )

    def views(self, draw: Taken, device: torch.device | str = "cpu") -> Tensor:
        """Return what every view's optics put on the sensor, (1, views, frames, h, w), light."""
        return self._run(draw.seen.to(device), 1, draw.backwards)[None]

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

    def _order(self, key: int) -> tuple[int, ...]:
        """Return which view of the bank each view shows."""
        places = range(self.bank.source.optics.views)
        if self.exchangeable:
            chances = noise.uniform(key, torch.arange(len(places))).tolist()
            places = sorted(places, key=chances.__getitem__)
        return tuple(places[place] for place in self.places)

    @staticmethod
    def _run(frames: Tensor, axis: int, backwards: bool) -> Tensor:
        return (frames.flip(axis) if backwards else frames).float()
