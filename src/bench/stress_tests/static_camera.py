"""Stress test of a static camera on a whole sensor: a photograph before which small things move."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import EventClip, StressBench, require_type
from src.bench.stress_tests.stress_results import StressResult, largest_value
from src.metrics.invented_contrast import find_unseen_pixels, invented_contrast
from src.recordings.noise_filter import find_supported_pixels
from src.sim.optics import layout
from src.sim.scenes.photographs import Photographs
from src.sim.sensor import EventSensor


def measure_invented_contrast(
    network: Candidate, bench: StressBench, *, limit_share: float, sizes: Sequence[Sequence[int]],
    windows: int = 20, sensor: Mapping[str, Any] | None = None,
) -> StressResult:  # fmt: skip
    """Return the invented contrast of the last frame, without turbulence, at the worst of `sizes`.

    `sizes`: (height, width) of the sensor, easy to hard; `windows`: of the clip; `sensor`: replaced
    arguments of EventSensor, such as its noise.  A network of any number of views is given one.
    """
    curve, views = [], network.loaded.views or 1
    for height, width in sizes:
        conditions = (height, width), windows, views, tuple((sensor or {}).items())
        simulate = partial(_simulate_clip, bench, *conditions)
        clips = bench.simulate_once(f"static camera {conditions}", simulate)
        shares = [_invented_contrast(network, clip) for clip in clips]
        curve.append((f"{width}x{height}", float(np.mean(shares))))
    return StressResult(largest_value(curve), "", limit_share, curve, "sensor")


def _simulate_clip(
    bench: StressBench, size: tuple[int, int], windows: int, views: int,
    changes: tuple[tuple[str, Any], ...], index: int,
) -> EventClip:  # fmt: skip
    """Return clip `index` of the bench's photographs behind small things that move."""
    own = require_type("scene", bench.pipeline.scene, Photographs)
    height, width = size
    scene = replace(
        own, height=height, width=width, frames=windows + 1, static_camera_share=1.0,
        cutout_widths=(0.05, 0.2), speed_widths_per_s=(0.2, 1.5),
    )  # fmt: skip
    clip = scene.clip(index)
    drawn = require_type("sensor", bench.pipeline.draw(index).sensor, EventSensor)
    sensor = replace(drawn, **dict(changes))
    events = [sensor.events(clip.frames, clip.fps, clip=index, view=k) for k in range(views)]
    return EventClip(events, clip.frames, clip.frames, clip.fps, layout(views))


def _invented_contrast(network: Candidate, clip: EventClip) -> float:
    height, width = clip.target.shape[-2:]
    seen = [find_supported_pixels([events], (height, width)) for events in clip.events]
    frames, _ = clip.reconstruct(replace(network, views=len(clip.positions)))
    return invented_contrast(frames[-1, 0].numpy(), find_unseen_pixels(np.any(seen, axis=0)))
