"""The stages in order: scene -> turbulence -> optics -> sensor -> voxel grids.

Only this file knows them all.
A sample is made in two steps.  `draw` fixes everything random about a clip from keys; it is cheap.
`simulate` is deterministic and runs where it is told to: on the CPU one clip at a time, so that
memory stays that of one clip, on a GPU a batch in one call of the sensor.  A sample is a function
of (configuration, number): not of the batch, the workers or the device, and view i depends on the
draws of view i only.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics, Position
from src.sim.scenes.photographs import Clip
from src.sim.sensor import batch
from src.sim.sensor.engines.run import zeros
from src.sim.sensor.response import encode_srgb
from src.sim.sensor.sensor import EventSensor, decode_srgb
from src.sim.turbulence.model import Air, Crop, TurbulenceModel


@dataclass(frozen=True)
class Draw:
    """All that is random about one clip, before anything is simulated.

    `air`: what the turbulence model drew, an `Atmosphere` where air is simulated.
    """

    clip: Clip
    crop: Crop
    air: Any
    sensor: EventSensor
    key: int
    number: int

    @property
    def threshold(self) -> float:
        """The ON threshold."""
        return self.sensor.threshold


@dataclass
class Sample:
    """A batch of simulated clips.

    `voxels` (n, windows, views, bins, h, w); `target` (n, windows, 1, h, w), the clean frame at the
    end of each window; `turbulent`, the same instants as the centre view shows them, code values
    too; `window_s` (n,), how long a window lasts; `positions`, the (row, col) of every view, None:
    those of `optics.layout`; `taught`, as `target`, what others make of these clips, if asked for;
    `drawn`, what was drawn for each clip; `seconds`, how long the simulation took.
    """

    voxels: Tensor
    target: Tensor
    turbulent: Tensor
    window_s: Tensor
    positions: Sequence[Position] | None = None
    drawn: list[dict] = field(default_factory=list)
    seconds: float = 0.0
    taught: Tensor | None = None

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Sample":
        """Return the sample with its tensors on `device`."""
        moved = {
            name: getattr(self, name).to(device, non_blocking=non_blocking)
            for name in ("voxels", "target", "turbulent", "window_s", "taught")
            if getattr(self, name) is not None
        }
        return replace(self, **moved)


class Pipeline:
    """From the number of a clip to a sample.

    `scene` has `clip(index)` with `windows * substeps + 1` frames; `turbulence` is
    a model of the air (src/sim/turbulence/model.py); `sensor` holds the keyword arguments of
    `EventSensor`.  `crop` is the side of the square to simulate: pixels
    (int), a share of the frame (float in (0, 1]) or None for all of it; it lies at random if
    `random_crop`, else in the middle.  `clips` is the number of different clips: number k shows
    clip k modulo `clips` (None: every number is a new clip).
    """

    def __init__(
        self,
        scene,
        optics: Optics,
        turbulence: TurbulenceModel,
        sensor: Mapping,
        *,
        split: str,
        seed: int = 0,
        bins: int = 5,
        substeps: int = 1,
        crop: int | float | None = None,
        random_crop: bool = False,
        clips: int | None = None,
    ):
        self.scene, self.optics, self.turbulence = scene, optics, turbulence
        # sRGB is decoded before the turbulence, which acts on light; the sensor then gets light.
        self.decode = sensor.get("input") == "srgb"
        light = {"input": "linear"} if self.decode else {}
        self.sensor = EventSensor(**dict(sensor) | light, seed=seed)
        self.split, self.seed = split, seed
        self.bins, self.substeps = bins, substeps
        self.crop, self.random_crop, self.clips = crop, random_crop, clips

    def draw(self, number: int) -> Draw:
        """Draw everything random about clip `number`."""
        index = number if self.clips is None else number % self.clips
        key = noise.key(self.seed, self.split, index)
        clip = self.scene.clip(index)
        crop = self._crop(clip.frames.shape[-2:], noise.key(key, number, "crop"))
        air = self.turbulence.draw(noise.generator(noise.key(key, "atmosphere")))
        return Draw(clip, crop, air, self.sensor.draw(key), key, number)

    def simulate(
        self,
        draws: Sequence[Draw],
        device: torch.device | str = "cpu",
        *,
        at_once: bool | None = None,
    ) -> Sample:
        """Simulate the drawn clips, of one size, on `device`.

        `at_once`: all of them in one call of the sensor, else one after the other, which gives the
        same and needs the memory of one clip's views; None: on all devices but the CPU.  Raises
        ValueError for clips of several sizes.
        """
        start = time.perf_counter()
        sizes = sorted({(len(draw.clip.frames), *draw.crop[2:]) for draw in draws})
        if len(sizes) != 1:
            raise ValueError(f"a batch must be of one size (frames, h, w), got {sizes}")
        if at_once is None:
            at_once = torch.device(device).type != "cpu"
        parts = [draws] if at_once else [[draw] for draw in draws]
        (frames, *size), views = sizes[0], self.optics.views
        shape = (len(draws), (frames - 1) // self.substeps, views, self.bins, *size)
        voxels = zeros(shape, torch.device(device))
        samples = [
            self.expose(part, self.batch_views(part, device), out)
            for part, out in zip(parts, voxels.split(len(parts[0])), strict=True)
        ]
        return replace(joined(samples, voxels), seconds=time.perf_counter() - start)

    def sample(self, draw: Draw, device: torch.device | str = "cpu") -> Sample:
        """Simulate one drawn clip on `device`."""
        return self.expose([draw], self.batch_views([draw], device))

    def expose(
        self,
        draws: Sequence[Draw],
        views: Float[Tensor, "n views frames h w"],
        out: Float[Tensor, "n windows views bins h w"] | None = None,
    ) -> Sample:
        """Return the sample of the clips whose `views`, float32 or float16, are those drawn; its
        voxel grids are in `out`, if given, which must hold zeros.
        """
        step, crops = self.substeps, [draw.crop for draw in draws]
        clean = [
            draw.clip.frames[step::step, top : top + height, left : left + width]
            for draw, (top, left, height, width) in zip(draws, crops, strict=True)
        ]
        voxels = batch.voxels(
            [draw.sensor for draw in draws],
            views,
            [draw.clip.fps for draw in draws],
            self.bins,
            substeps=step,
            clips=[draw.key for draw in draws],
            views=self.optics.view_ids,
            origins=[crop[:2] for crop in crops],
            full_widths=[draw.clip.frames.shape[-1] for draw in draws],
            thresholds=torch.tensor([draw.threshold for draw in draws]).tolist(),  # float32's
            out=out,
        )
        turbulent = views[:, self.optics.centre, step::step].float()
        turbulent = encode_srgb(turbulent) if self.decode else turbulent
        return Sample(
            voxels=voxels,
            target=torch.stack(clean).to(views.device)[:, :, None],
            turbulent=turbulent[:, :, None],
            window_s=torch.tensor([step / draw.clip.fps for draw in draws]),
            positions=self.optics.positions,
            drawn=[self._drawn(draw) for draw in draws],
        )

    def batch_views(
        self, draws: Sequence[Draw], device: torch.device | str = "cpu"
    ) -> Float[Tensor, "n views frames h w"]:
        """Return the `views` of several clips of one size."""
        views = [self.views(draw, device) for draw in draws]
        return views[0] if len(views) == 1 else torch.cat(views)

    def views(self, draw: Draw, device: torch.device | str = "cpu") -> Tensor:
        """Return what every view's optics put on the sensor, (1, views, frames, h, w), light."""
        clean = draw.clip.frames.to(device)[None]
        radiance = decode_srgb(clean) if self.decode else clean
        if draw.clip.lamp is not None:  # it changes the light, not the ground truth
            radiance = radiance * draw.clip.lamp.to(device)
        views = self.operator(draw).degrade(radiance, self.drawer(draw), crop=draw.crop)
        size = tuple(clean.shape[-2:])
        return self.optics.misalign(views, draw.key, origin=draw.crop[:2], full_size=size)

    def record(self, draw: Draw) -> dict:
        """Return what is known of the air of a clip: its severity, how it is made, errors."""
        return dict(self.operator(draw).facts)

    def tilt(self, draw: Draw) -> Tensor:
        """Return how far every view sees each pixel displaced, (views, frames, 2, h, w), pixels."""
        frames = len(draw.clip.frames)
        return self.operator(draw).tilt(frames, self.drawer(draw), crop=draw.crop)

    def operator(self, draw: Draw) -> Air:
        """Return the turbulence of a clip."""
        height, width = draw.clip.frames.shape[-2:]
        size = {"height": height, "width": width, "fps": draw.clip.fps}
        return self.turbulence.operator(draw.air, views=self.optics.positions, **size)

    def drawer(self, draw: Draw) -> torch.Generator:
        """Return the generator that the turbulence of a clip draws from."""
        return noise.generator(noise.key(draw.key, "turbulence"))

    def _drawn(self, draw: Draw) -> dict:
        drawn = {"clip": draw.number, "name": draw.clip.name, "threshold": draw.threshold}
        drawn |= {name: getattr(draw.sensor, name) for name in self.sensor.drawn}
        return drawn | self.record(draw)

    def _crop(self, size: Sequence[int], key: int) -> Crop:
        height, width = size
        if self.crop is None:
            return 0, 0, height, width
        side = self.crop
        if isinstance(side, float):
            side = round(side * min(height, width))
        if not 8 <= side <= min(height, width):
            raise ValueError(
                f"data.crop must be in 8..{min(height, width)} (the frame), got {side}"
            )
        if not self.random_crop:
            return (height - side) // 2, (width - side) // 2, side, side
        top, left = noise.uniforms(key, 2)
        return int(top * (height - side + 1)), int(left * (width - side + 1)), side, side


def joined(samples: Sequence[Sample], voxels: Tensor | None = None) -> Sample:
    """Return the batch of `samples`, which are of one size, in the same order; `voxels`: theirs, if
    they lie in one tensor already.
    """
    first = samples[0]
    if voxels is None:
        voxels = together([sample.voxels for sample in samples])
    return Sample(
        voxels=voxels,
        target=torch.cat([sample.target for sample in samples]),
        turbulent=torch.cat([sample.turbulent for sample in samples]),
        window_s=torch.cat([sample.window_s for sample in samples]),
        positions=first.positions,
        drawn=[drawn for sample in samples for drawn in sample.drawn],
        taught=None if first.taught is None else torch.cat([sample.taught for sample in samples]),
    )


def together(parts: Sequence[Tensor]) -> Tensor:
    """Return `torch.cat(parts)`."""
    shape = (sum(map(len, parts)), *parts[0].shape[1:])
    return torch.cat(parts, out=room(shape, parts[0].device))


def room(shape: Sequence[int], device: torch.device) -> Tensor:
    """Return float32 to be filled, on the CPU in numpy's memory: in huge pages it costs a third to
    fill.
    """
    if device.type != "cpu":
        return torch.empty(shape, device=device)
    return torch.from_numpy(np.empty(shape, np.float32))


def simulate(
    pipeline: Pipeline, numbers: Sequence[int], device: torch.device | str = "cpu"
) -> Sample:
    """Draw and simulate the clips `numbers`."""
    return pipeline.simulate([pipeline.draw(number) for number in numbers], device)
