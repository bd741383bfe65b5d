"""Stress test of a static camera on a whole sensor: a photograph before which small things move."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from src.bench.candidates import Candidate
from src.bench.stress_tests.event_clips import EventClip, StressBench, require_type
from src.bench.stress_tests.stress_results import StressResult
from src.metrics.invented_contrast import find_unseen, invented_contrast
from src.recordings.noise_filter import NoiseFilter
from src.sim.optics import layout
from src.sim.scenes.photographs import Photographs
from src.sim.sensor import EventSensor

SUPPORT_S = 0.005  # of NoiseFilter: what is noise reveals nothing


def measure_invented_contrast(
    network: Candidate, bench: StressBench, *, limit_share: float, sizes: Sequence[Sequence[int]],
    windows: int = 20, sensor: Mapping[str, Any] | None = None,
) -> StressResult:  # fmt: skip
    """Return the invented contrast of the last frame, without turbulence, at the worst of `sizes`.

    `sizes`: (height, width) of the sensor, easy to hard; `windows`: of the clip; `sensor`: replaced
    arguments of EventSensor, such as its noise.  A network of any number of views is given one.
    """
    curve = []
    for height, width in sizes:
        shares = [
            _invented_contrast(
                network, _clip(network, bench, index, (height, width), windows, sensor)
            )
            for index in bench.indices
        ]
        curve.append((f"{width}x{height}", float(np.nanmean(shares))))
    worst = max(value for _, value in curve)
    return StressResult(worst, "", limit_share, curve, "sensor")


def _clip(
    network: Candidate, bench: StressBench, index: int, size: tuple[int, int], windows: int,
    changes: Mapping[str, Any] | None,
) -> EventClip:  # fmt: skip
    own = require_type("scene", bench.pipeline.scene, Photographs)
    height, width = size
    scene = replace(
        own, height=height, width=width, frames=windows + 1, static_camera_share=1.0,
        cutout_widths=(0.05, 0.2), speed_widths_per_s=(0.2, 1.5),
    )  # fmt: skip
    clip = scene.clip(index)
    plain = require_type("sensor", bench.pipeline.sensor, EventSensor)
    threshold = bench.pipeline.draw(index).sensor.threshold
    sensor = replace(plain, **{"threshold": threshold, **(changes or {})})
    places = layout(network.loaded.views or 1)
    events = [sensor.events(clip.frames, clip.fps, clip=index, view=k) for k in range(len(places))]
    return EventClip(events, clip.frames, clip.frames, clip.fps, places)


def _invented_contrast(network: Candidate, clip: EventClip) -> float:
    height, width = clip.target.shape[-2:]
    has_events = np.zeros((height, width), bool)
    for events in clip.events:
        kept = NoiseFilter((height, width), SUPPORT_S)(events)
        has_events[kept["y"], kept["x"]] = True
    frames, _ = clip.reconstruct(replace(network, views=len(clip.positions)))
    return invented_contrast(frames[-1, 0].numpy(), find_unseen(has_events))
