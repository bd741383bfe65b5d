"""The protocol of EVREAL (Ercan et al. 2023): windows of a sequence, what a network is given of
each, and the scores of its frames against the camera's.

Its rules, as published: events before the first frame are in no window, the last frame is not
scored, and a network reads empty windows too.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from src.metrics.evreal_scores import (
    EQUALISATIONS,
    PERCENTILES,
    Picture,
    normalise_output,
    score_frame,
)
from src.metrics.lpips import LPIPS
from src.models.network import WINDOW_S, EventToVideoNetwork
from src.recordings.files.evreal_folder import EvrealSequence
from src.sim.voxel import voxel_grid

CHOICES = {
    "window": ("frames", "events", "seconds"), "grid_edges": ("events", "window"),
    "output_normalisation": tuple(PERCENTILES), "histogram": EQUALISATIONS,
}  # fmt: skip
SHORTEST_S = 1e-9  # of a grid; events closer together are spread over its bins in their order


@dataclass(frozen=True)
class EvrealRule:
    """How a sequence is cut, reconstructed and scored; conf/data/evreal.yaml says what each means.

    Raises ValueError for a value out of range.
    """

    window: str = "frames"
    events_per_window: int = 10_000
    window_s: float = 0.04
    max_grid_s: float | None = None
    grid_edges: str = "events"
    output_normalisation: str = "none"
    histogram: str = "none"
    tolerance_ms: float = 1.0
    warm_up_s: float = 10.0

    def __post_init__(self):
        for name, known in CHOICES.items():
            if (value := getattr(self, name)) not in known:
                raise ValueError(f"data.{name} must be one of {', '.join(known)}, got {value}")
        for name in ("events_per_window", "window_s", "max_grid_s"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:
                raise ValueError(f"data.{name} must be > 0, got {value}")
        for name in ("tolerance_ms", "warm_up_s"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"data.{name} must be >= 0, got {getattr(self, name)}")


class EvrealWindow(NamedTuple):
    """Events first_event .. stop_event - 1 of a sequence, between `start_s` and `end_s`; the frame
    of the camera that is nearest to `time_s`, at which the network's frame counts."""

    first_event: int
    stop_event: int
    start_s: float
    end_s: float
    time_s: float
    nearest_camera_frame: int


class ScoredFrame(NamedTuple):
    """A reconstruction (h, w) in [0, 1] and its scores; `window_index`: in the sequence."""

    window_index: int
    evreal_window: EvrealWindow
    picture: Picture
    scores: dict[str, float]


def cut_evreal_windows(sequence: EvrealSequence, rule: EvrealRule) -> Iterator[EvrealWindow]:
    """Yield the windows of a sequence with frames."""
    t, frame_t, index = sequence.t, sequence.frame_t, sequence.last_event_index
    assert frame_t is not None and index is not None
    if rule.window == "frames":
        camera_frames = np.arange(len(frame_t) - 1)
        before = np.maximum(camera_frames - 1, 0)
        first, stop, start_s, end_s = index[before], index[:-1], frame_t[before], frame_t[:-1]
        time_s = end_s
    elif rule.window == "events":
        first = np.arange(0, len(t) - rule.events_per_window + 1, rule.events_per_window)
        stop = first + rule.events_per_window
        start_s, end_s = t[first], t[stop - 1]
        time_s = end_s
    else:
        count = int((float(t[-1]) - float(t[0])) / rule.window_s)
        start_s = rule.window_s * np.arange(count) + float(t[0])
        end_s = start_s + rule.window_s
        stop = np.searchsorted(t, end_s)
        first = np.append(0, stop)[:-1]
        held_s = np.where(
            first > 0, t[first - 1] + np.float64(rule.window_s), 0.0
        )  # of an empty window
        time_s = np.where(stop > first, t[stop - 1], held_s)
    if rule.window != "frames":  # of two as near the earlier
        camera_frames = np.array([np.abs(frame_t - time).argmin() for time in time_s], np.int64)
    columns = first, stop, start_s, end_s, time_s, camera_frames
    yield from map(EvrealWindow, *(column.tolist() for column in columns))


def check_scored_range(sequence: EvrealSequence, window: str, start_s: float, end_s: float) -> None:
    """Raise ValueError where no frame is to be scored, or the events end before more than one."""
    path, frame_t = sequence.path, sequence.frame_t
    if frame_t is None:
        raise ValueError(f"{path}: holds events but no frames (images.npy)")
    times = frame_t[:-1]
    times = times[(times >= start_s) & (times <= end_s)]
    asked = f"data.start_s={start_s:g} and data.end_s={end_s:g}"
    if not len(times):
        has = f"it has {len(frame_t)}, up to {frame_t.max(initial=0):.3f} s"
        raise ValueError(f"{path}: no frame to score between {asked}; {has}")
    late = int((times > sequence.t[-1]).sum())
    if window == "frames" and late > 1:
        ends = f"the events end at {sequence.t[-1]:.3f} s, before {late} of {len(times)} frames"
        raise ValueError(f"{path}: {ends} between {asked}")


@torch.inference_mode()
def score_sequence(
    sequence: EvrealSequence, network: EventToVideoNetwork, rule: EvrealRule, *, bins: int = 5,
    start_s: float, end_s: float, lpips: LPIPS | None = None, device: torch.device | str = "cpu",
) -> Iterator[ScoredFrame]:  # fmt: skip
    """Yield the frames of `network`, in eval mode, that fall into the scored range.

    Raises ValueError, which begins with the path, for events off the sensor.
    """
    assert sequence.images is not None and sequence.frame_t is not None
    state = None
    for number, window in enumerate(cut_evreal_windows(sequence, rule)):
        if window.time_s < start_s - rule.warm_up_s:
            continue
        if window.time_s > end_s:
            break
        frame, state = _reconstruct(sequence, window, network, state, rule, bins, device)
        distance_ms = 1e3 * abs(
            float(sequence.frame_t[window.nearest_camera_frame]) - window.time_s
        )
        if window.time_s >= start_s and distance_ms <= rule.tolerance_ms:
            picture = normalise_output(frame, rule.output_normalisation).clip(0, 1)
            truth = sequence.images[window.nearest_camera_frame][..., 0].astype(np.float32) / 255
            scores = score_frame(picture, truth, rule.histogram, lpips, device)
            yield ScoredFrame(number, window, picture, scores)


def _reconstruct(
    sequence: EvrealSequence, window: EvrealWindow, network: EventToVideoNetwork, state: Any,
    rule: EvrealRule, bins: int, device: torch.device | str,
) -> tuple[Picture, Any]:  # fmt: skip
    """Return the frame at the end of a window, which is given in parts where they are wanted."""
    length = window.end_s - window.start_s
    parts = math.ceil(length / rule.max_grid_s - 1e-6) if rule.max_grid_s and length > 0 else 1
    edges = np.linspace(window.start_s, window.end_s, parts + 1)
    first, stop = window.first_event, window.stop_event
    inside = first + np.searchsorted(sequence.t[first:stop], edges[1:-1])
    cuts = [first, *inside.tolist(), stop]
    window_s = length / parts if length > 0 else WINDOW_S
    for k in range(parts):
        span = (edges[k], edges[k + 1]) if rule.grid_edges == "window" else None
        grid = fill_evreal_grid(sequence, cuts[k], cuts[k + 1], bins, span)[None, None].to(device)
        frame, state = network(grid, state, window_s=window_s, positions=[(0, 0)])
    return frame[0, 0].float().cpu().numpy(), state


def fill_evreal_grid(
    sequence: EvrealSequence, first_event: int, stop_event: int, bins: int,
    span: tuple[float, float] | None = None,
) -> Float[Tensor, "bins h w"]:  # fmt: skip
    """Return the voxel grid of events first_event .. stop_event - 1 between the first and last of
    them, or between the two times of `span`, in seconds.  Raises ValueError for an event off the
    sensor."""
    height, width = sequence.size
    t = np.array(sequence.t[first_event:stop_event], np.float64)
    if not len(t):
        return torch.zeros(bins, height, width)
    start, end = (t[0], t[-1]) if span is None else span
    t = np.clip(t - start, 0, max(end - start, 0))
    if end - start < SHORTEST_S:
        t, start, end = np.linspace(0, 1, len(t)), 0.0, 1.0
    x, y = np.array(sequence.xy[first_event:stop_event]).T
    sign = np.where(np.array(sequence.p[first_event:stop_event]) > 0, 1, -1).astype(np.int8)
    try:
        sides = {"height": height, "width": width}
        return voxel_grid(t, x, y, sign, t0=0.0, t1=float(end - start), bins=bins, **sides)
    except ValueError as error:
        raise ValueError(f"{sequence.path}: from event {first_event} on, {error}") from None
