"""What the probes show: simulated clips as events of every view, to be cut at any rate.

A clip is simulated once; the same events are then cut into windows of any length.  What is changed
about a clip (turbulence, sensor, gain of a view) is said by `Conditions`.
"""

from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.sim import noise
from src.sim.pipeline import Draw, Pipeline
from src.sim.turbulence.atmosphere import Atmosphere
from src.sim.turbulence.model import TurbulenceModel
from src.sim.turbulence.simulated import SimulatedAir
from src.sim.voxel import voxel_grid

BINS = 5
MICRO = 1e6
GAIN_MEMORY = 0.9  # of a view's gain from frame to frame


@dataclass(frozen=True)
class Conditions:
    """How a clip differs from the standard one.

    `d_over_r0`: strength of the turbulence, 0 for none (None: as drawn).  `moves`: the share
    of the clip after which the scene stands.  `gain`: standard deviation of a view's brightness,
    flickering frame by frame.
    `turbulence`, `sensor`: arguments of SimulatedAir and EventSensor that are replaced.  `course`:
    instead of one strength, those of equal parts of the clip, in the same moving air.
    """

    d_over_r0: float | None = None
    moves: float = 1.0
    gain: float = 0.0
    turbulence: Mapping[str, Any] = field(default_factory=dict)
    sensor: Mapping[str, Any] = field(default_factory=dict)
    course: Sequence[float] = ()

    @property
    def changes_air(self) -> bool:
        """Whether the turbulence is another than the standard clip's."""
        return bool(self.turbulence or self.course) or self.d_over_r0 is not None


@dataclass(frozen=True)
class Stream:
    """Events of every view (t in microseconds from the first frame) and the truth at `fps`."""

    events: list[np.ndarray]
    target: Float[Tensor, "frames h w"]
    turbulent: Float[Tensor, "frames h w"]
    fps: float
    positions: tuple[tuple[int, int], ...]

    @property
    def seconds(self) -> float:
        """The length of the clip."""
        return (len(self.target) - 1) / self.fps

    def windows(self, rate: float, seconds: float | None = None) -> Iterator[Tensor]:
        """Yield grids (1, views, bins, h, w) of `rate` windows a second, for at most `seconds`."""
        length = min(seconds or self.seconds, self.seconds)
        for k in range(round(length * rate)):
            yield self._grids(k * MICRO / rate, (k + 1) * MICRO / rate)[None]

    def voxels(self) -> Float[Tensor, "1 windows views bins h w"]:
        """Return the grids at the clip's own rate, all in one."""
        return torch.stack(list(self.windows(self.fps)), 1)

    def _grids(self, start: float, end: float) -> Tensor:
        height, width = self.target.shape[-2:]
        grids = []
        for seen in self.events:
            # Ticks belong to the window in which they fall, as the sensor has it.
            first, stop = np.searchsorted(seen["t"], np.ceil([start - 1e-6, end - 1e-6]))
            part = seen[first:stop]
            edges = {"t0": start, "t1": end + 1e-3}
            size = {"bins": BINS, "height": height, "width": width}
            grids.append(voxel_grid(part["t"], part["x"], part["y"], part["p"], **edges, **size))
        return torch.stack(grids)


def film(pipeline: Pipeline, number: int, conditions: Conditions) -> Stream:
    """Simulate clip `number` of `pipeline` under `conditions`, the centre of its frame.

    All randomness is that of the standard clip, so that conditions are compared on the same air.
    Raises ValueError for a strength that is asked for where no turbulence is drawn, and for other
    air where it is not simulated.
    """
    variant = copy(pipeline)
    if conditions.changes_air:
        variant.turbulence = simulated(pipeline.turbulence).having(**conditions.turbulence)
    draw = _changed(pipeline.draw(number), conditions)
    course = conditions.course
    views = _course(variant, draw, course) if course else variant.views(draw)[0]
    if conditions.gain:
        views = _flicker(views, conditions.gain, noise.key(draw.key, "gain"))
    sensor = pipeline.sensor.having(**{"threshold": draw.threshold} | dict(conditions.sensor))
    ids = pipeline.optics.view_ids
    top, left, height, width = draw.crop
    return Stream(
        [
            sensor.events(seen.contiguous(), draw.clip.fps, clip=number, view=i)
            for i, seen in zip(ids, views, strict=True)
        ],
        draw.clip.frames[:, top : top + height, left : left + width],
        views[pipeline.optics.centre],
        draw.clip.fps,
        pipeline.optics.positions,
    )


def simulated(model: TurbulenceModel) -> SimulatedAir:
    """Return the model; raises ValueError for air that is not simulated: no probe can change it."""
    if not isinstance(model, SimulatedAir):
        kind = type(model).__name__
        raise ValueError(f"turbulence must be simulated for a probe of it, got {kind}")
    return model


def strengthened(atmosphere: Atmosphere | None, d_over_r0: float) -> Atmosphere | None:
    """Return the same path with another strength; 0 is no turbulence."""
    if d_over_r0 == 0:
        return None
    if atmosphere is None:
        raise ValueError("turbulence must be on for a probe of its strength, got none")
    return atmosphere.at(d_over_r0)


def _course(pipeline: Pipeline, draw: Draw, strengths: Sequence[float]) -> Tensor:
    """Return what the views see as the strength goes through `strengths` in equal parts."""
    frames = len(draw.clip.frames)
    part = torch.arange(frames) * len(strengths) // frames
    views = None
    for strength in sorted(set(strengths)):
        seen = pipeline.views(replace(draw, air=strengthened(draw.air, strength)))[0]
        views = seen.clone() if views is None else views
        now = torch.tensor([strengths[k] == strength for k in part])
        views[:, now] = seen[:, now]
    return views


def _changed(draw: Draw, conditions: Conditions) -> Draw:
    if conditions.moves < 1:
        last = int(conditions.moves * (len(draw.clip.frames) - 1))
        shown = torch.arange(len(draw.clip.frames)).clamp(max=last)
        draw = replace(draw, clip=replace(draw.clip, frames=draw.clip.frames[shown]))
    if conditions.d_over_r0 is not None:
        draw = replace(draw, air=strengthened(draw.air, conditions.d_over_r0))
    return draw


def _flicker(views: Tensor, spread: float, key: int) -> Tensor:
    """Multiply every view by a gain that wanders, an autoregression of log-normal spread."""
    number, frames = views.shape[:2]
    drawn = noise.normal(key, torch.arange(number * frames)).view(number, frames)
    gains = [drawn[:, 0]]
    for k in range(1, frames):
        gains.append(GAIN_MEMORY * gains[-1] + (1 - GAIN_MEMORY**2) ** 0.5 * drawn[:, k])
    gain = (spread * torch.stack(gains, 1)).exp()
    return (views * gain[:, :, None, None]).clamp(0, 1)
