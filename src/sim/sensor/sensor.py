"""The event sensor: frames in, events or voxel grids out, with exact crossing times.

Between two frames the log intensity of a pixel is linear in time; an event is the moment at which
it is a threshold away from the pixel's reference.  Levels and thresholds are integers and noise is
a function of (seed, clip, view, pixel, frame), so all engines, crops and batches agree bit for
bit.  The sensor's clock ticks in microseconds: an event of frame interval k is stamped with the
tick in which it falls, in [edge_k, edge_k+1) with edge_k = ceil(k 10^6 / fps).
"""

from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from src.sim import noise
from src.sim.sensor.engines import run, sensor_cpu
from src.sim.sensor.engines.job import Job, State
from src.sim.sensor.jobs import make_job, whole_windows
from src.sim.sensor.limits import check, threshold_range
from src.sim.sensor.response import decode_srgb

__all__ = ["EVENT", "EventSensor", "State", "decode_srgb"]

EVENT = sensor_cpu.EVENT


class EventSensor:
    """An event camera's pixels.

    `threshold` C, in nat of intensity as `input` has it, one number or a range (low, high) out of
    which `sample_threshold` draws a clip's; `off_ratio`, the OFF threshold over the ON threshold.
    `refractory_s` the dead time after an event; `refractory` what becomes of a crossing within it:
    `defer` (the reference waits, the event comes when the dead time ends; v2e), `delete` (the
    reference moves on, the event is lost; ESIM), `hold` (the pixel is in reset and starts from the
    level at the end; hardware).  `stamps`: `linear`, the crossing's own time, or `v2e`, spread
    evenly by the busiest pixel of the view.  `input`: `linear`, the frames are taken for intensity
    as they are, or `srgb`, the frames are decoded here; whoever decodes them before passes
    `linear`.  `response`: `log` of max(intensity, floor), or `linlog`, v2e's.
    `mismatch`: relative deviation of a pixel's thresholds, fixed per (seed, view, pixel).
    `leak_hz`: ON events of a pixel in the dark.  `shot_hz`: noise events of a black pixel (a white
    one has a quarter).  `hot_fraction` of the pixels make `hot_hz` noise events.  `cutoff_hz`: the
    photoreceptor's low-pass at full intensity, 0 for none.  `residual`: how far a pixel's reference
    is from its first level, uniform up to so many thresholds either way: what it saw before is not
    known.  `drawn`: ranges out of which `draw` takes a clip's numbers, log-uniform, or uniform
    where the range begins with 0; with probability `drawn_share`, else they are the sensor's own.
    """

    def __init__(
        self,
        threshold: float | Sequence[float] = 0.2,
        *,
        refractory_s: float = 0.005,
        refractory: str = "defer",
        stamps: str = "linear",
        input: str = "linear",
        mismatch: float = 0.0,
        leak_hz: float = 0.0,
        shot_hz: float = 0.0,
        seed: int = 0,
        response: str = "log",
        floor: float = 1 / 255,
        off_ratio: float = 1.0,
        hot_fraction: float = 0.0,
        hot_hz: float = 0.0,
        cutoff_hz: float = 0.0,
        residual: float = 0.0,
        drawn: Mapping[str, Any] | None = None,
        drawn_share: float = 1.0,
    ):
        self.threshold = threshold if isinstance(threshold, int | float) else tuple(threshold)
        self.refractory_s, self.refractory, self.stamps = refractory_s, refractory, stamps
        self.input, self.response, self.floor = input, response, floor
        self.mismatch, self.off_ratio = mismatch, off_ratio
        self.leak_hz, self.shot_hz = leak_hz, shot_hz
        self.hot_fraction, self.hot_hz, self.cutoff_hz = hot_fraction, hot_hz, cutoff_hz
        self.residual, self.seed = residual, seed
        self.drawn, self.drawn_share = dict(drawn or {}), drawn_share
        check(vars(self))

    def having(self, **settings) -> "EventSensor":
        """Return the same sensor with other `settings`, arguments of the class."""
        sensor = copy(self)
        vars(sensor).update(settings)
        check(vars(sensor))
        return sensor

    def draw(self, key: int, seed: int | None = None) -> "EventSensor":
        """Return the sensor of one clip, its numbers drawn from `key`; of another `seed`, if any.

        The threshold's own range is uniform, from the stream that `sample_threshold` draws from.
        """
        sensor = copy(self)
        sensor.threshold = self.sample_threshold(noise.generator(noise.key(key, "threshold")))
        some = _uniform(key, "drawn") < self.drawn_share
        for name, (low, high) in self.drawn.items() if some else ():
            share = _uniform(key, name)
            drawn = low * (high / low) ** share if low > 0 else high * share
            setattr(sensor, name, min(drawn, high))
        sensor.drawn, sensor.seed = {}, self.seed if seed is None else seed
        return sensor

    def sample_threshold(self, generator: torch.Generator) -> float:
        """Return one clip's threshold: uniform in the range, or the number itself."""
        low, high = threshold_range(self.threshold)
        return low + (high - low) * float(torch.rand((), generator=generator))

    def voxels(
        self,
        frames: Float[Tensor, "n views frames h w"],
        fps: float,
        bins: int = 5,
        *,
        substeps: int = 1,
        clips: Sequence[int] | None = None,
        views: Sequence[int] | None = None,
        origin: tuple[int, int] = (0, 0),
        full_width: int | None = None,
        threshold: Float[Tensor, " n"] | None = None,
    ) -> Float[Tensor, "n views windows bins h w"]:
        """Return one grid per window of `substeps` frame intervals, float32 on the frames' device;
        in memory the windows come before the views.

        `fps` is the rate of `frames`; intensities in [0, 1].  `clips` and `views` (ids) and the
        crop's `origin` (top, left) in a frame `full_width` wide key the noise.  `threshold`: ON
        threshold per clip, instead of the sensor's.  Frames after the last whole window are not
        simulated.  Raises ValueError for frames that are not finite or outside [0, 1], or too few.
        """
        frames = whole_windows(frames, substeps)
        return self.step(
            frames, fps, None, bins, substeps=substeps, clips=clips, views=views, origin=origin,
            full_width=full_width, threshold=threshold,
        )[0]  # fmt: skip

    def step(
        self,
        frames: Float[Tensor, "n views frames h w"],
        fps: float,
        state: State | None = None,
        bins: int = 5,
        *,
        substeps: int = 1,
        **keys,
    ) -> tuple[Float[Tensor, "n views windows bins h w"], State]:
        """Return the grids of a chunk and the state to go on from; `keys` as in `voxels`.

        With `state` None the first frame only sets the references; later chunks hold new frames
        only, a whole number of windows of them.  Raises ValueError as `voxels` does; a `state` that
        was given with wrong intensities is then lost.
        """
        job = self._job(frames, fps, state, substeps, **keys)
        n, views, _, h, w = frames.shape
        grids = run.zeros((n, job.intervals // substeps, views, bins, h, w), frames.device)
        return run.voxels(job, grids).transpose(1, 2), job.state

    def counts(
        self, frames: Float[Tensor, "n views frames h w"], fps: float, **keys
    ) -> Int[Tensor, "n views 2"]:
        """Return the numbers of ON and OFF events of each clip and view; `keys` as in `voxels`."""
        return sensor_cpu.counts(self._job(frames.cpu(), fps, None, 1, **keys))

    def events(
        self, frames: Float[Tensor, "frames h w"], fps: float, *, clip: int = 0, view: int = 0,
        origin: tuple[int, int] = (0, 0), full_width: int | None = None,
    ) -> np.ndarray:  # fmt: skip
        """Return the events of one view in order of time: t int64 us, x, y uint16, p int8 -1 or 1.

        Time starts at the first frame.  Raises ValueError as `voxels` does.
        """
        keys = {"clips": [clip], "views": [view], "origin": origin, "full_width": full_width}
        return sensor_cpu.events(self._job(frames[None, None].cpu(), fps, None, 1, **keys))

    def _job(
        self, frames, fps, state, substeps, *, clips=None, views=None, origin=(0, 0),
        full_width=None, threshold=None,
    ) -> Job:  # fmt: skip
        n, v, w = len(frames), frames.shape[1], frames.shape[-1]
        return make_job(
            [self] * n,
            frames,
            [fps] * n,
            state,
            substeps=substeps,
            clips=range(n) if clips is None else clips,
            views=range(v) if views is None else views,
            origins=[origin] * n,
            full_widths=[w if full_width is None else full_width] * n,
            thresholds=None if threshold is None else threshold.double().tolist(),
        )


def _uniform(key: int, name: str) -> float:
    """Return a number in [0, 1), one of each name."""
    return noise.uniforms(noise.key(key, "sensor", name), 1)[0]
