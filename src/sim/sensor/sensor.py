"""The event sensor: frames in, events or voxel grids out, with exact crossing times.

Between two frames the log intensity of a pixel is linear in time; an event is the moment at which
it is a threshold away from the pixel's reference.  Levels and thresholds are integers and noise is
a function of (seed, clip, view, pixel, frame), so all engines, crops and batches agree bit for
bit.  Events are stamped in microseconds, those of frame interval k in [edge_k, edge_k+1) with
edge_k = ceil(k 10^6 / fps).
"""

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim import noise
from src.sim.sensor.engine_input import (
    COMMON,
    SensorClip,
    build_engine_input,
    check_frames,
    check_settings,
    threshold_range,
)
from src.sim.sensor.engines import run, sensor_cpu
from src.sim.sensor.engines.records import EngineInput, Grids

# What the random numbers of a setting are keyed by, where it is not the setting's name.
RANDOM_STREAMS = {
    "leak_event_hz": "leak_hz",
    "dark_noise_hz": "shot_hz",
    "hot_pixel_fraction": "hot_fraction",
    "hot_pixel_hz": "hot_hz",
    "initial_reference_error": "residual",
}


ViewFrames = Float[Tensor, "n views frames h w"]  # intensities in [0, 1]


@runtime_checkable
class Sensor(Protocol):
    """The pixels behind all views: the contract of `sensor._target_`.

    The class is given the values of the config and `seed`; `input`, where the config has it, is
    `linear` for frames that were decoded before the turbulence.  `write=` of src.simulate and
    src.stress also want `events` of it, `calibrate task=threshold` `counts`, as in `EventSensor`.
    """

    threshold: Any  # of the sensor that `draw` returns, a number: recorded
    random: Mapping[str, Any]  # names of the attributes that differ from clip to clip: recorded

    def draw(self, key: int, pixel_seed: int | None = None) -> "Sensor":
        """Return the sensor of one clip, all that is random about it drawn from `key`, its pixels
        those of `pixel_seed` (None: of its own seed)."""

    def voxels(
        self, frames: ViewFrames, fps: float, bins: int = 5, *, substeps: int = 1,
        clips: Sequence[int] | None = None, views: Sequence[int] | None = None,
        origin: tuple[int, int] = (0, 0), full_width: int | None = None,
    ) -> Float[Tensor, "n views windows bins h w"]:  # fmt: skip
        """Return one grid per window of `substeps` frame intervals; see `EventSensor.voxels`."""


@dataclass(eq=False)
class EventSensor:
    """An event camera's pixels.

    `threshold` C, in nat of intensity as `input` has it, one number or a range (low, high) out of
    which `draw` takes a clip's, uniform; `off_ratio`, the OFF threshold over the ON threshold.
    `refractory_s` the dead time after an event; `refractory` what becomes of a crossing within it:
    `defer` (the event comes when the dead time ends; v2e), `delete` (the event is lost, the
    reference moves on; ESIM), `hold` (the pixel starts from the level at the end; hardware).
    `stamps`: `linear`, the crossing's own time, or `v2e`, spread evenly by the pixel of the view
    with most crossings.  `input`: the frames are taken for intensity (`linear`) or decoded here
    (`srgb`), but for `dark_noise_hz`, which follows the code value; pipelines give decoded frames.
    `response`: `log` of max(intensity, floor), or `linlog`, v2e's.
    `mismatch`: relative deviation of a pixel's thresholds, fixed per (seed, view, pixel).
    `leak_event_hz`: ON events of a pixel whose light does not change; references then begin up to
    one ON threshold below the first level, so that they come from the start.  `dark_noise_hz`:
    noise events of a black pixel (a white one has a quarter).  `hot_pixel_fraction` of the pixels
    make `hot_pixel_hz` noise events.  `cutoff_hz`: the photoreceptor's low-pass at full intensity,
    0 for none.  `initial_reference_error`: how far a pixel's reference is from its first level,
    uniform up to so many thresholds either way: what it saw before is not known.  `random`: ranges
    out of which `draw` takes a clip's numbers, log-uniform, or uniform where the range begins with
    0; with probability `random_share`, else they are the sensor's own.
    """

    threshold: float | Sequence[float] = 0.2
    _: KW_ONLY
    refractory_s: float = 0.005
    refractory: str = "defer"
    stamps: str = "linear"
    input: str = "linear"
    mismatch: float = 0.0
    leak_event_hz: float = 0.0
    dark_noise_hz: float = 0.0
    seed: int = 0
    response: str = "log"
    floor: float = 1 / 255
    off_ratio: float = 1.0
    hot_pixel_fraction: float = 0.0
    hot_pixel_hz: float = 0.0
    cutoff_hz: float = 0.0
    initial_reference_error: float = 0.0
    random: Mapping[str, Any] = field(default_factory=dict)
    random_share: float = 1.0

    def __post_init__(self) -> None:
        check_settings(vars(self))

    def draw(self, key: int, pixel_seed: int | None = None) -> "EventSensor":
        low, high = threshold_range(self.threshold)
        generator = noise.generator(noise.key(key, "threshold"))
        drawn: dict[str, Any] = {"random": {}}
        drawn["threshold"] = low + (high - low) * float(torch.rand((), generator=generator))
        if _uniform(key, "drawn") < self.random_share:
            for name, (low, high) in self.random.items():
                share = _uniform(key, RANDOM_STREAMS.get(name, name))
                drawn[name] = min(low * (high / low) ** share if low > 0 else high * share, high)
        return replace(self, **drawn, seed=self.seed if pixel_seed is None else pixel_seed)

    def voxels(
        self, frames: ViewFrames, fps: float, bins: int = 5, *, substeps: int = 1,
        clips: Sequence[int] | None = None, views: Sequence[int] | None = None,
        origin: tuple[int, int] = (0, 0), full_width: int | None = None,
    ) -> Float[Tensor, "n views windows bins h w"]:  # fmt: skip
        """Return one grid per window of `substeps` frame intervals, float32 on the frames' device;
        in memory the windows come before the views.

        `fps` is the rate of `frames`; intensities in [0, 1].  `clips` and `views` (ids) and the
        crop's `origin` (top, left) in a frame `full_width` wide key the noise.  Frames after the
        last whole window are not simulated.  Raises ValueError for frames that are not finite or
        outside [0, 1], or too few.
        """
        given = self._engine_input(frames, fps, clips, views, origin, full_width, substeps)
        n, v, count, h, w = given.frames.shape
        grids = run.zeros((n, (count - 1) // substeps, v, bins, h, w), frames.device)
        return run.voxels(given, grids).transpose(1, 2)

    def counts(
        self, frames: ViewFrames, fps: float, clips: Sequence[int] | None = None, *,
        first_interval: int = 0,
    ) -> Int[Tensor, "n views 2"]:  # fmt: skip
        """Return the numbers of ON and OFF events of each clip and view; `clips` as in `voxels`.

        Events between frames before number `first_interval` are simulated and not counted.
        """
        given = self._engine_input(frames.cpu(), fps, clips)
        return sensor_cpu.counts(given._replace(first_interval=first_interval))

    def events(
        self, frames: Float[Tensor, "frames h w"], fps: float, *, clip: int = 0, view: int = 0,
        origin: tuple[int, int] = (0, 0), full_width: int | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return the events of one view in order of time: t int64 us, x, y uint16, p int8 -1 or 1.

        Time starts at the first frame.  Raises ValueError as `voxels` does.
        """
        one = frames[None, None].cpu()
        return sensor_cpu.events(self._engine_input(one, fps, [clip], [view], origin, full_width))

    def _engine_input(
        self, frames: Tensor, fps: float, clips: Sequence[int] | None = None,
        views: Sequence[int] | None = None, origin: tuple[int, int] = (0, 0),
        full_width: int | None = None, substeps: int = 1,
    ) -> EngineInput:  # fmt: skip
        width = frames.shape[-1] if full_width is None else full_width
        keys = range(len(frames)) if clips is None else clips
        views = range(frames.shape[1]) if views is None else views
        sensor_clips = [SensorClip(self, fps, key, origin, width) for key in keys]
        return build_engine_input(sensor_clips, frames, views, substeps=substeps)


def simulate_voxels(
    clips: Sequence[SensorClip], frames: ViewFrames, views: Sequence[int], *, bins: int = 5,
    substeps: int = 1, out: Grids | None = None,
) -> Grids:  # fmt: skip
    """Return the grids of n clips, contiguous and on the frames' device: in `out`, if given, which
    must be so too and hold zeros.

    Equal bit for bit to `voxels` of each clip's sensor; `frames` (float32, or float16 which is
    widened as it is read) may lie in memory in any order; `views`: ids.  `EventSensor`s of the same
    settings go through their engine together, a sensor of another class by itself.  Raises
    ValueError as `EventSensor.voxels` does.
    """
    check_frames(frames, len(clips), len(views), substeps)
    n, v, count, h, w = frames.shape
    shape = (n, (count - 1) // substeps, v, bins, h, w)
    out = run.zeros(shape, frames.device) if out is None else out
    if tuple(out.shape) != shape or not out.is_contiguous():
        raise ValueError(f"out must be contiguous {shape}, got {tuple(out.shape)}")
    groups: dict[object, list[int]] = {}
    for i, (sensor, *_) in enumerate(clips):
        together: object = i  # what is derived from EventSensor may do everything else
        if type(sensor) is EventSensor:
            together = *(getattr(sensor, name) for name in COMMON), sensor.cutoff_hz > 0
        groups.setdefault(together, []).append(i)
    for group in groups.values():
        whole, own = len(group) == n, [clips[i] for i in group]
        seen = frames if whole else frames[group]
        grids = out if whole else run.zeros((len(group), *shape[1:]), frames.device)
        sensor, fps, key, origin, full_width = own[0]
        if type(sensor) is EventSensor:
            run.voxels(build_engine_input(own, seen, views, substeps=substeps), grids)
        else:
            found = sensor.voxels(
                seen.float(), fps, bins, substeps=substeps, clips=[key], views=views,
                origin=origin, full_width=full_width,
            )  # fmt: skip
            grids.copy_(found.transpose(1, 2))
        if not whole:
            out[group] = grids
    return out


def _uniform(key: int, name: str) -> float:
    return noise.uniforms(noise.key(key, "sensor", name), 1)[0]
