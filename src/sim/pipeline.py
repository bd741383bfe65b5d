"""From the number of a clip to voxel grids: clean clip, turbulence of each view, sensor, grids.

`draw` fixes everything random about a clip from keys; `simulate` is deterministic.  A sample is a
function of (configuration, number): not of the batch, the workers or the device, and view i depends
on the draws of view i only.
"""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.optics import Optics, Position
from src.sim.scenes.clip import Clip, Scene
from src.sim.sensor.engine_input import SensorClip
from src.sim.sensor.engines.records import Grids
from src.sim.sensor.engines.run import zeros
from src.sim.sensor.response import decode_srgb, encode_srgb
from src.sim.sensor.sensor import Sensor, ViewFrames, simulate_voxels
from src.sim.turbulence.contract import (
    ClipTurbulence,
    Crop,
    Tilt,
    TurbulenceModel,
    describe_clip_turbulence,
)

Pictures = Float[Tensor, "n windows 1 h w"]  # code values in [0, 1]


@dataclass(frozen=True)
class ClipParameters:
    """All that is random about one clip, before anything is simulated.

    `turbulence`: what the turbulence model drew, an `Atmosphere` where it is simulated.
    """

    clip: Clip
    crop: Crop
    turbulence: Any
    sensor: Sensor
    key: int
    number: int


@dataclass
class Sample:
    """A batch of simulated clips.

    `target`: the clean frame at the end of each window; `turbulent`: the same instants as the
    centre view shows them, code values too; `window_s`: how long a window lasts; `positions`: the
    (row, col) of every view, None: those of `optics.layout`; `teacher_frames`: of the teachers, if
    asked for; `parameters`: what was drawn for each clip.
    """

    voxels: Grids
    target: Pictures
    turbulent: Pictures
    window_s: Float[Tensor, " n"]
    positions: Sequence[Position] | None = None
    parameters: list[dict] = field(default_factory=list)
    teacher_frames: Pictures | None = None

    def tensors(self) -> dict[str, Tensor]:
        return {name: value for name, value in vars(self).items() if isinstance(value, Tensor)}

    def to(self, device: torch.device | str, non_blocking: bool = False) -> "Sample":
        """Return the sample with its tensors on `device`."""
        moved: Any = {k: v.to(device, non_blocking=non_blocking) for k, v in self.tensors().items()}
        return replace(self, **moved)


@dataclass(eq=False)
class Pipeline:
    """From the number of a clip to a sample.

    `scene.clip(index)` has windows * substeps + 1 frames.  `decodes_srgb`: they are decoded to
    light before the turbulence.  `crop` is the side of the square to simulate: pixels (int), a
    share of the frame (float in (0, 1]) or None for all of it, `crop_key` in errors; it lies at
    random if `random_crop`, else in the middle.  Number k shows clip k modulo `clips` (None: every
    number is a new clip).  Pixel mismatch and hot pixels differ between training clips; those of
    the other splits share one sensor.
    """

    scene: Scene
    optics: Optics
    turbulence: TurbulenceModel
    sensor: Sensor
    _: KW_ONLY
    split: str
    seed: int = 0
    bins: int = 5
    substeps: int = 1
    crop: int | float | None = None
    crop_key: str = "data.crop"
    random_crop: bool = False
    clips: int | None = None
    decodes_srgb: bool = False

    @property
    def repeats_samples(self) -> bool:
        """Whether there are only so many samples; a random crop is another one for each number."""
        return self.clips is not None and (self.crop is None or not self.random_crop)

    def draw(self, number: int) -> ClipParameters:
        """Draw everything random about clip `number`."""
        index = number if self.clips is None else number % self.clips
        key, clip = noise.key(self.seed, self.split, index), self.scene.clip(index)
        crop = self._crop_box(clip.frames.shape[-2:], noise.key(key, number, "crop"))
        turbulence = self.turbulence.draw(noise.generator(noise.key(key, "atmosphere")))
        pixels = noise.key(key, "chip") if self.split == "train" else None
        sensor = self.sensor.draw(key, pixel_seed=pixels)
        return ClipParameters(clip, crop, turbulence, sensor, key, number)

    def simulate(
        self, draws: Sequence[ClipParameters], device: torch.device | str = "cpu", *,
        batched: bool | None = None,
    ) -> Sample:  # fmt: skip
        """Simulate the drawn clips on `device`; raises ValueError for clips of several sizes.

        `batched`: all of them in one call of the sensor, else one after the other, which gives the
        same and needs the memory of one clip's views; None: on all devices but the CPU.
        """
        sizes = sorted({(len(draw.clip.frames), *draw.crop[2:]) for draw in draws})
        if len(sizes) != 1:
            raise ValueError(f"a batch must be of one size (frames, h, w), got {sizes}")
        if batched is None:
            batched = torch.device(device).type != "cpu"
        groups = [draws] if batched else [[draw] for draw in draws]
        (frames, *size), views = sizes[0], self.optics.views
        shape = (len(draws), (frames - 1) // self.substeps, views, self.bins, *size)
        voxels = zeros(shape, torch.device(device))
        samples = [
            self.simulate_sensor(group, self.render_views(group, device), out)
            for group, out in zip(groups, voxels.split(len(groups[0])), strict=True)
        ]
        return concatenate_samples(samples, voxels)

    def render_views(
        self, draws: Sequence[ClipParameters], device: torch.device | str = "cpu"
    ) -> ViewFrames:
        """Return the light of every view on the sensor."""
        views = [self._render_clip(draw, device) for draw in draws]
        return views[0] if len(views) == 1 else torch.cat(views)

    def _render_clip(self, draw: ClipParameters, device: torch.device | str) -> Tensor:
        clean = draw.clip.frames.to(device)[None]
        radiance = decode_srgb(clean) if self.decodes_srgb else clean
        if draw.clip.illumination is not None:  # it changes the light, not the ground truth
            radiance = radiance * draw.clip.illumination.to(device)
        operator, generator = self.turbulence_operator(draw), self.turbulence_generator(draw)
        return operator.degrade(radiance, generator, crop=draw.crop)

    def simulate_sensor(
        self, draws: Sequence[ClipParameters], views: ViewFrames, out: Grids | None = None
    ) -> Sample:
        """Return the sample of the clips whose `views`, float32 or float16, are those drawn; its
        voxel grids are in `out`, if given, which must hold zeros.
        """
        step, ids = self.substeps, self.optics.random_key_ids
        clips = [
            SensorClip(d.sensor, d.clip.fps, d.key, d.crop[:2], d.clip.frames.shape[-1])
            for d in draws
        ]
        voxels = simulate_voxels(clips, views, ids, bins=self.bins, substeps=step, out=out)
        turbulent = views[:, self.optics.centre, step::step].float()
        turbulent = encode_srgb(turbulent) if self.decodes_srgb else turbulent
        clean = torch.stack([crop_frames(d.clip.frames[step::step], d.crop) for d in draws])
        return Sample(
            voxels=voxels,
            target=clean.to(views.device)[:, :, None],
            turbulent=turbulent[:, :, None],
            window_s=torch.tensor([step / clip.fps for clip in clips], dtype=torch.float32),
            positions=self.optics.positions,
            parameters=[self._record(draw) for draw in draws],
        )

    def tilt(self, draw: ClipParameters) -> Tilt:
        """Return how far every view sees each pixel displaced."""
        frames, generator = len(draw.clip.frames), self.turbulence_generator(draw)
        return self.turbulence_operator(draw).tilt(frames, generator, crop=draw.crop)

    def turbulence_operator(self, draw: ClipParameters) -> ClipTurbulence:
        """Return the turbulence of a clip; `draw.turbulence` may be that already, prepared."""
        drawn, (height, width) = draw.turbulence, draw.clip.frames.shape[-2:]
        if isinstance(drawn, ClipTurbulence):
            return drawn
        options: Any = {"views": self.optics.positions, "fps": draw.clip.fps}
        return self.turbulence.operator(drawn, height=height, width=width, **options)

    def turbulence_generator(self, draw: ClipParameters) -> torch.Generator:
        return noise.generator(noise.key(draw.key, "turbulence"))

    def turbulence_record(self, draw: ClipParameters) -> dict:
        """Return the parameters of a clip's turbulence; a cache holds its own."""
        operator, generator = self.turbulence_operator(draw), self.turbulence_generator(draw)
        return describe_clip_turbulence(operator, generator)

    def _record(self, draw: ClipParameters) -> dict:
        drawn = {"clip": draw.number, "name": draw.clip.name, "source": draw.clip.source}
        drawn["threshold"] = draw.sensor.threshold
        drawn |= {name: getattr(draw.sensor, name) for name in self.sensor.random}
        return drawn | self.turbulence_record(draw)

    def _crop_box(self, size: Sequence[int], key: int) -> Crop:
        height, width = size
        if self.crop is None:
            return 0, 0, height, width
        least = min(height, width)
        side = round(self.crop * least) if isinstance(self.crop, float) else self.crop
        if not 8 <= side <= least:
            raise ValueError(f"{self.crop_key} must be in 8..{least}, the clip's side, got {side}")
        if not self.random_crop:
            return (height - side) // 2, (width - side) // 2, side, side
        top, left = noise.uniforms(key, 2)
        return int(top * (height - side + 1)), int(left * (width - side + 1)), side, side


def simulate(
    pipeline: Pipeline, numbers: Sequence[int], device: torch.device | str = "cpu"
) -> Sample:
    """Draw and simulate the clips `numbers`."""
    return pipeline.simulate([pipeline.draw(number) for number in numbers], device)


def concatenate_samples(samples: Sequence[Sample], voxels: Tensor | None = None) -> Sample:
    """Return the batch of `samples`, of one size; `voxels`: theirs, if in one tensor already."""
    whole: dict[str, Any] = {} if voxels is None else {"voxels": voxels}
    for name in samples[0].tensors().keys() - whole:
        parts = [getattr(sample, name) for sample in samples]
        shape = (sum(map(len, parts)), *parts[0].shape[1:])
        whole[name] = torch.cat(parts, out=allocate_float32(shape, parts[0].device))
    parameters = [drawn for sample in samples for drawn in sample.parameters]
    return replace(samples[0], **whole, parameters=parameters)


def allocate_float32(shape: Sequence[int], device: torch.device) -> Tensor:
    """Return float32 to be filled, on the CPU in numpy's huge pages, a third of the cost."""
    if device.type != "cpu":
        return torch.empty(*shape, dtype=torch.float32, device=device)
    return torch.from_numpy(np.empty(tuple(shape), np.float32))


def crop_frames(frames: Float[Tensor, "*any h w"], crop: Crop) -> Tensor:
    top, left, height, width = crop
    return frames[..., top : top + height, left : left + width]
