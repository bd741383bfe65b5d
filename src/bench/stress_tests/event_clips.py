"""Simulated clips as events of every view, to be cut into windows at any rate.

A clip is simulated once under its `ClipConditions`: turbulence, sensor, motion, gain of a view,
light of a lamp.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import accumulate
from statistics import fmean
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from src.bench.candidates import Candidate
from src.metrics.video_metrics import score_aligned_psnr
from src.models.backward_warmup import reverse_voxels
from src.recordings.event_windows import build_window_rule
from src.sim import noise
from src.sim.optics import Position
from src.sim.pipeline import Pipeline, crop_frames
from src.sim.scenes.mixture import draw_flicker
from src.sim.sensor import EventSensor
from src.sim.turbulence.simulated import SimulatedTurbulence
from src.sim.voxel import voxel_grid

Part = TypeVar("Part")
BINS = 5
US_PER_S = 1e6
GAIN_AR1_COEFFICIENT = 0.9  # of a view's log gain, frame by frame
LAMP_SAMPLES = 8  # of a lamp's light for each frame


Curve = list[tuple[Any, float]]  # (setting, value), from easy to hard
Film = Float[Tensor, "frames h w"]
Video = Float[Tensor, "windows 1 h w"]


def compute_losses_against_best(reference_db: float, scores_db: Curve) -> Curve:
    """Return (setting, dB lost) of each setting against the best of the reference and the settings
    before it; NaN from the first score on that is NaN.
    """
    scores = [score for _, score in scores_db]
    best = np.maximum.accumulate([reference_db, *scores])
    return [(name, float(b - s)) for (name, s), b in zip(scores_db, best[:-1], strict=True)]


@dataclass(frozen=True)
class ClipConditions:
    """How a clip differs from the standard one.

    `d_over_r0`: turbulence strength, 0 for none (None: as drawn).  `stop_after_share`: the share of
    the clip after which the scene stands still.  `view_log_gain_std`: standard deviation of each
    view's log gain, an AR(1) process over frames.  `lamp_modulation_depth`: percent flicker, in
    [0, 1), of a lamp on mains that lights the scene.  `turbulence`, `sensor`: arguments of
    SimulatedTurbulence and EventSensor that are replaced.
    """

    d_over_r0: float | None = None
    stop_after_share: float = 1.0
    view_log_gain_std: float = 0.0
    lamp_modulation_depth: float = 0.0
    turbulence: Mapping[str, Any] = field(default_factory=dict)
    sensor: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def from_settings(cls, settings: Mapping[str, Any]) -> "ClipConditions":
        """Return the conditions of {"d_over_r0" or "sensor.<argument>" ...: value}."""
        fields: dict[str, Any] = {"turbulence": {}, "sensor": {}}
        for key, value in settings.items():
            group, _, name = key.partition(".")
            target = fields[group] if name else fields
            target[name or group] = value
        return cls(**fields)


@dataclass(frozen=True)
class EventClip:
    """Events of every view (t in microseconds from the first frame) and the truth at `fps`.

    `turbulent`: the light of the centre view.
    """

    events: list[np.ndarray]
    target: Film
    turbulent: Film
    fps: float
    positions: Sequence[Position]

    @property
    def duration_s(self) -> float:
        return (len(self.target) - 1) / self.fps

    @property
    def truth(self) -> Video:
        """The true frame at the end of every window."""
        return self.target[1:, None]

    def windows(self) -> Iterator[Float[Tensor, "1 views bins h w"]]:
        """Yield the voxel grids of `fps` windows a second."""
        for k in range(len(self.target) - 1):
            yield self.voxel_grids(k * US_PER_S / self.fps, (k + 1) * US_PER_S / self.fps)

    def voxel_grids(self, start_us: float, end_us: float) -> Float[Tensor, "1 views bins h w"]:
        """Return the grids of all views of the window [start_us, end_us)."""
        height, width = self.target.shape[-2:]
        size = {"bins": BINS, "height": height, "width": width}
        grids = []
        for events in self.events:
            # Ticks belong to the window in which they fall, as the sensor has it.
            ends = np.searchsorted(events["t"], np.ceil([start_us - 1e-6, end_us - 1e-6]))
            t, x, y, p = (events[slice(*ends)][name] for name in "txyp")
            grids.append(voxel_grid(t, x, y, p, t0=start_us, t1=end_us + 1e-3, **size))
        return torch.stack(grids)[None]

    def back_and_forth(self) -> tuple[list[Tensor], Film]:
        """Return the windows of the clip followed by those of its reverse, and the truth."""
        forth = list(self.windows())
        back = [reverse_voxels(window) for window in reversed(forth)]
        return forth + back, torch.cat([self.target[1:], self.target[:-1].flip(0)])

    def reconstruct(
        self, network: Candidate, windows: Iterable[Tensor] | None = None, state: Any = None
    ) -> tuple[Video, Any]:
        """Return the frames that `network` makes of `windows` (None: those of the clip), each
        1 / `fps` long, and its state.
        """
        windows = self.windows() if windows is None else windows
        return network.reconstruct(windows, self.positions, 1 / self.fps, state)

    def reconstruct_at_rate(
        self, network: Candidate, fps: float, numbers: Sequence[int], window_length: str = "frame"
    ) -> Video:
        """Return the frames of `numbers`, counted from 1, of `fps` a second, in order of time.

        `window_length`: `frame`, `trained` or `growing`, as in src.reconstruct; those of a network
        that uses their length always grow.
        """
        grows = network.loaded.uses_window_length
        rule = build_window_rule("growing" if grows else window_length, fps=fps)
        video, period_us, wanted = [], US_PER_S / fps, set(numbers)
        states: list[Any] = [None] * rule.overlapping_windows
        continued = {k % len(states) for k in wanted}
        for k in range(1, max(wanted) + 1):
            start_us, end_us = rule.first_frame_of_window(k) * period_us, k * period_us
            phase, keeps_state = k % len(states), rule.keeps_state(start_us, end_us)
            if k not in wanted and not (keeps_state and phase in continued):
                continue
            window, length_s = self.voxel_grids(start_us, end_us), (end_us - start_us) / US_PER_S
            frame, after = network.reconstruct([window], self.positions, length_s, states[phase])
            if keeps_state:
                states[phase] = after
            if k in wanted:
                video.append(frame)
        return torch.cat(video)


def simulate_event_clip(pipeline: Pipeline, index: int, conditions: ClipConditions) -> EventClip:
    """Simulate clip `index` of `pipeline` under `conditions`, the centre of its frame.

    All randomness is that of the standard clip, so that conditions are compared on the same draws.
    Raises ValueError for a strength where no turbulence is drawn, and for other turbulence where it
    is not simulated.
    """
    variant, draw = copy(pipeline), pipeline.draw(index)
    if conditions.turbulence or conditions.d_over_r0 is not None:
        simulated = require_type("turbulence", pipeline.turbulence, SimulatedTurbulence)
        options = simulated.options | dict(conditions.turbulence)
        variant.turbulence = SimulatedTurbulence(simulated.atmosphere, **options)
    if conditions.stop_after_share < 1:
        last = int(conditions.stop_after_share * (len(draw.clip.frames) - 1))
        kept = torch.arange(len(draw.clip.frames)).clamp(max=last)
        draw = replace(draw, clip=replace(draw.clip, frames=draw.clip.frames[kept]))
    if conditions.d_over_r0 == 0:
        draw = replace(draw, turbulence=None)
    elif conditions.d_over_r0 is not None:
        if draw.turbulence is None:
            raise ValueError("turbulence must be on for a stress test of its strength, got none")
        draw = replace(draw, turbulence=draw.turbulence.with_d_over_r0(conditions.d_over_r0))
    views = variant.render_views([draw])[0]
    if conditions.view_log_gain_std:
        views = _apply_gain(views, conditions.view_log_gain_std, noise.key(draw.key, "gain"))
    sensor = require_type("sensor", draw.sensor, EventSensor)
    sensor = replace(sensor, **dict(conditions.sensor))
    fps, ids = draw.clip.fps, pipeline.optics.random_key_ids
    target, turbulent = crop_frames(draw.clip.frames, draw.crop), views[pipeline.optics.centre]
    light, light_fps = views, fps
    if depth := conditions.lamp_modulation_depth:
        light_fps = LAMP_SAMPLES * fps
        light = _light_by_lamp(views, light_fps, depth, noise.key(draw.key, "lamp"))
    events = [
        sensor.events(view.contiguous(), light_fps, clip=index, view=i)
        for i, view in zip(ids, light, strict=True)
    ]
    return EventClip(events, target, turbulent, fps, pipeline.optics.positions)


def require_type(key: str, part: object, kind: type[Part]) -> Part:
    """Return `part`; raises ValueError unless it is a `kind`."""
    if not isinstance(part, kind):
        got = type(part).__name__
        raise ValueError(f"{key} must be a {kind.__name__} for this stress test, got {got}")
    return part


def _apply_gain(views: Tensor, std: float, key: int) -> Tensor:
    """Multiply every view by a log-normal gain that is AR(1) over frames."""
    count, frames = views.shape[:2]
    drawn = noise.normal(key, torch.arange(count * frames)).view(count, frames)
    old, innovation = GAIN_AR1_COEFFICIENT, (1 - GAIN_AR1_COEFFICIENT**2) ** 0.5
    gains = accumulate(drawn.unbind(1), lambda gain, new: old * gain + innovation * new)
    gain = (std * torch.stack(list(gains), 1)).exp()
    return (views * gain[:, :, None, None]).clamp(0, 1)


def _light_by_lamp(views: Tensor, fps: float, depth: float, key: int) -> Tensor:
    """Return the views (views, frames, h, w) at `fps`, LAMP_SAMPLES times theirs, in the light of a
    lamp; between two frames light is linear, as the sensor takes it.
    """
    frames = (views.shape[1] - 1) * LAMP_SAMPLES + 1
    pixels = views.flatten(2).transpose(1, 2)
    dense = functional.interpolate(pixels, size=frames, mode="linear", align_corners=True)
    times_s, size = np.arange(frames) / fps, (views.shape[2], views.shape[3])
    lamp = draw_flicker(np.random.default_rng(key), times_s, size, (depth, depth))
    return dense.transpose(1, 2).unflatten(2, size) * lamp


class StressBench:
    """Clips `indices` of `pipeline`; frames of the first `warmup` windows are not scored."""

    def __init__(self, pipeline: Pipeline, indices: Sequence[int], warmup: int):
        self.pipeline, self.indices, self.warmup = pipeline, indices, warmup
        self._clips: dict[str, list[EventClip]] = {}
        self._psnr: dict[tuple[str, str], float] = {}

    def clips(self, conditions: ClipConditions = ClipConditions()) -> list[EventClip]:
        """Return the clips under `conditions`; each is simulated once."""
        simulate = partial(simulate_event_clip, self.pipeline, conditions=conditions)
        return self.simulate_once(repr(conditions), simulate)

    def simulate_once(self, name: str, simulate: Callable[[int], EventClip]) -> list[EventClip]:
        """Return the clips that `simulate` makes of the indices; made once for a `name`."""
        if name not in self._clips:
            self._clips[name] = [simulate(index) for index in self.indices]
        return self._clips[name]

    def mean_aligned_psnr(
        self, network: Candidate, conditions: ClipConditions = ClipConditions(),
        change: Callable[[Tensor], Tensor] | None = None,
    ) -> float:  # fmt: skip
        """Return the aligned PSNR in dB at the clips' own rate, mean over clips.

        `change` is applied to every window (1, views, bins, h, w).  Without it the result is stored
        under the name of the network.
        """
        key = network.name, repr(conditions)
        if change is None and key in self._psnr:
            return self._psnr[key]
        scores = []
        for clip in self.clips(conditions):
            windows = map(change, clip.windows()) if change else clip.windows()
            scores.append(self.clip_aligned_psnr(clip.reconstruct(network, windows)[0], clip))
        if change is None:
            self._psnr[key] = fmean(scores)
        return fmean(scores)

    def aligned_psnr_losses(
        self, network: Candidate, changes: Mapping[Any, Callable[[Tensor], Tensor]]
    ) -> Curve:
        """Return (setting, dB lost) for each change of the windows of the standard clips."""
        scores = [(name, self.mean_aligned_psnr(network, change=c)) for name, c in changes.items()]
        return compute_losses_against_best(self.mean_aligned_psnr(network), scores)

    def clip_aligned_psnr(self, frames: Video, clip: EventClip) -> float:
        """Return the mean of `score_aligned_psnr` over the frames after the warm-up; NaN where no
        truth has contrast."""
        return float(score_aligned_psnr(frames[self.warmup :], clip.truth[self.warmup :]).mean())
