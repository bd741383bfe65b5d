"""Events of any length to windows of voxel grids, in memory that does not grow.

A network trained on windows of 1/120 s that is fed shorter ones gets fewer events and runs its
recurrence more often: it fades.  So windows may overlap: each spans `frames_per_window` frames and
continues the recurrent state of the window that ended where it starts.  Each of these interleaved
phases is the reconstruction at the trained rate, and every event counts once per phase.  Or windows
may grow, for a network that uses their length: each begins where the last one of
`frames_per_window` frames ended, whose state it continues, and the state after it is kept if it
has as many itself.  Times are microseconds of the recording's clock in float64.
"""

import math
import warnings
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from src.models.backward_warmup import check_backward_warmup_s
from src.recordings.files.event_arrays import concatenate_events, count_before
from src.recordings.noise_filter import NoiseFilter, check_noise_filter_s
from src.recordings.sensor_lookup import SensorLookup

COVERED = 0.99  # of the last window, or the recording ends before it
TRAINED_WINDOW_S = 1 / 120
GROWN_WINDOW_S = 1 / 2000  # to which windows grow: shorter ones lose PSNR, longer ones a fast dart
WINDOW_LENGTHS_S = {"frame": 0.0, "trained": TRAINED_WINDOW_S, "growing": GROWN_WINDOW_S}


class VoxelContributions(NamedTuple):
    """What each event adds to a voxel grid: seconds since the window's start, pixel, weight, view;
    one entry for every pixel that an event contributes to."""

    t_s: np.ndarray
    x: np.ndarray
    y: np.ndarray
    weight: np.ndarray
    view: np.ndarray


@dataclass(frozen=True)
class Window:
    """The events in [start_us, end_us): the number of `events` in views, and of
    `events_outside` of all views.

    They lie in `voxels` or, for an EventListRuntime, in `event_list`.  Unless it `keeps_state` the
    window grows on: a network continues from the state before it.
    """

    start_us: float
    end_us: float
    events: int
    events_outside: int
    voxels: Float[np.ndarray, "views bins h w"] | None = None
    event_list: VoxelContributions | None = None
    keeps_state: bool = True

    @property
    def length_s(self) -> float:
        return (self.end_us - self.start_us) * 1e-6

    def reversed(self) -> "Window":
        """Return the window with time reversed: last event first, polarity inverted."""
        if self.voxels is not None:
            return replace(self, voxels=-self.voxels[:, ::-1])
        assert self.event_list is not None
        t, x, y, weight, view = (part[::-1] for part in self.event_list)
        return replace(self, event_list=VoxelContributions(self.length_s - t, x, y, -weight, view))


@dataclass(frozen=True)
class WindowRule:
    """How windows are cut and filled: each ends 1 / fps after the one before and is
    frames_per_window / fps long or, where it `grows`, up to that.  `start_s` and `end_s` count from
    the first event.  `noise_filter_s`: windows hold only what a NoiseFilter keeps.  `as_lists`:
    windows hold an event list instead of a grid.  Raises ValueError for a value out of range.
    """

    fps: float = 120.0
    frames_per_window: int = 1
    grows: bool = False
    bins: int = 5
    splat: str = "bilinear"
    start_s: float = 0.0
    end_s: float = float("inf")
    noise_filter_s: float | None = None
    as_lists: bool = False

    def __post_init__(self):
        if not 0 < self.fps <= 1e6:
            raise ValueError(f"fps must be in (0, 1e6], got {self.fps}")
        if self.splat not in ("bilinear", "nearest"):
            raise ValueError(f"splat must be bilinear or nearest, got {self.splat}")
        if self.bins < 1:
            raise ValueError(f"bins must be >= 1, got {self.bins}")
        if self.noise_filter_s is not None:
            check_noise_filter_s(self.noise_filter_s)
        check_time_range(self.start_s, self.end_s)

    @property
    def overlapping_windows(self) -> int:
        """How many windows, each with a state of its own, overlap at any time."""
        return 1 if self.grows else self.frames_per_window

    def first_frame_of_window(self, end: int) -> int:
        """Return the frame, counted from 0, with which the window begins that ends before frame
        `end`; below 0 where it begins before the recording."""
        n = self.frames_per_window
        return (end - 1) // n * n if self.grows else end - n

    def keeps_state(self, start_us: float, end_us: float) -> bool:
        """Return whether a network keeps the state after this window."""
        frames = round((end_us - start_us) * 1e-6 * self.fps)
        return not self.grows or frames >= self.frames_per_window


def check_time_range(start_s: float, end_s: float, node: str = "") -> None:
    """Raise ValueError unless 0 <= `start_s` < `end_s`, in seconds; `node`: what their config keys
    begin with, such as `data.`."""
    if not 0 <= start_s < end_s:
        wanted = f"{node}start_s must be >= 0 and before {node}end_s"
        raise ValueError(f"{wanted}, got {start_s}, {end_s}")


def build_window_rule(window_length: str, **settings: Any) -> WindowRule:
    """Return the WindowRule of `settings` whose windows are a `frame` long, overlap (`trained`:
    TRAINED_WINDOW_S long) or are `growing` up to GROWN_WINDOW_S; both are rounded to frames, one at
    least.  Raises ValueError for another length."""
    if window_length not in WINDOW_LENGTHS_S:
        allowed = ", ".join(WINDOW_LENGTHS_S)
        raise ValueError(f"window_length must be one of {allowed}, got {window_length}")
    rule = WindowRule(**settings)
    frames = max(1, round(WINDOW_LENGTHS_S[window_length] * rule.fps))
    return replace(rule, frames_per_window=frames, grows=window_length == "growing")


Cut = tuple[np.ndarray, float, float]  # events of a window, its start and end in us


def cut_windows(
    chunks: Iterable[np.ndarray], lookup: SensorLookup, rule: WindowRule
) -> Iterator[Window]:
    """Cut chunks of events (t x y p, in order of time) into windows; warns of an `end_s` after the
    last event.  Raises ValueError for time running backwards, an event of a window that is off the
    sensor, less than one window, or a noise filter that keeps nothing."""
    checked, is_empty = _OrderedChunks(chunks, _build_noise_filter(rule, lookup)), True
    for events, start_us, end_us in _cut(checked, rule):
        yield fill_window(events, lookup, rule, start_us, end_us)
        is_empty = False
    if is_empty:
        raise ValueError(_explain_no_window(rule, checked))
    if checked.length_s + 1 / rule.fps < rule.end_s < math.inf:
        wanted = f"end_s must be at most the length of the recording, {checked.length_s:.3f} s"
        warnings.warn(f"{wanted}, got {rule.end_s:g}; it is read to its end", stacklevel=1)


def _build_noise_filter(rule: WindowRule, lookup: SensorLookup) -> NoiseFilter | None:
    if rule.noise_filter_s is None:
        return None
    height, width = lookup.view.shape
    return NoiseFilter((height, width), rule.noise_filter_s)


class _OrderedChunks:
    """Chunks of events in order of time, of each what `noise_filter` keeps, from the first on of
    which it keeps some; the first and the last time so far, in us, whatever is kept."""

    def __init__(self, chunks: Iterable[np.ndarray], noise_filter: NoiseFilter | None = None):
        self._chunks, self._noise_filter = chunks, noise_filter
        self.first_us, self.last_us = math.nan, math.nan
        self.is_all_noise = noise_filter is not None

    def __iter__(self) -> Iterator[np.ndarray]:
        for chunk in filter(len, self._chunks):
            t = chunk["t"]
            if (np.diff(t) < 0).any() or t[0] < self.last_us:
                raise ValueError(
                    "recording must not run backwards in time, an event is before the last"
                )
            self.first_us = float(t[0]) if math.isnan(self.first_us) else self.first_us
            self.last_us = float(t[-1])
            kept = self._noise_filter(chunk) if self._noise_filter else chunk
            self.is_all_noise = self.is_all_noise and not len(kept)
            if not self.is_all_noise:
                yield kept

    @property
    def length_s(self) -> float:
        """From the first event to the last; 0 without events."""
        return 0.0 if math.isnan(self.first_us) else (self.last_us - self.first_us) * 1e-6


def _explain_no_window(rule: WindowRule, chunks: _OrderedChunks) -> str:
    length_s, window = chunks.length_s, f"one window of 1/{rule.fps:g} s"
    if length_s and chunks.is_all_noise:
        return f"noise_filter_s must leave events, got {rule.noise_filter_s:g}, which leaves none"
    if 0 < length_s <= rule.start_s:
        wanted = f"below the length of the recording, {length_s:.3f} s"
        return f"start_s must be {wanted}, got {rule.start_s:g}"
    given = f"got {rule.start_s:g} and {rule.end_s:g}"
    if rule.start_s + 1 / rule.fps > rule.end_s:  # then it is not read to its end
        return f"start_s and end_s must be at least {window} apart, {given}"
    if length_s > 1 / rule.fps and rule.start_s:
        wanted = f"leave {window} of the recording, {length_s:.3f} s long"
        return f"start_s and end_s must {wanted}, {given}"
    return describe_short_recording(rule.fps, length_s)


def describe_short_recording(fps: float, length_s: float) -> str:
    """Return the error of a recording of `length_s` in which no window of 1 / `fps` is whole."""
    return f"recording must be longer than one window of 1/{fps:g} s, got {length_s:g} s"


def cut_windows_backward(
    chunks: Iterable[np.ndarray], lookup: SensorLookup, rule: WindowRule, seconds: float
) -> Iterator[Window]:
    """Yield the windows of the first `seconds`, one length of a window at least, the last first,
    each `reversed`; of those that grow the longest only; as many as are a multiple of those that
    overlap, so that `ReconstructionState.reverse` gives every phase its state.  Raises ValueError
    as `cut_windows` and for an impossible length of time.
    """
    if rule.grows:
        rule = replace(rule, fps=rule.fps / rule.frames_per_window, frames_per_window=1)
    seconds = max(check_backward_warmup_s(seconds), rule.frames_per_window / rule.fps)
    end_s = min(rule.end_s, rule.start_s + seconds)
    checked = _OrderedChunks(chunks, _build_noise_filter(rule, lookup))
    cuts = list(_cut(checked, replace(rule, end_s=end_s)))
    whole = len(cuts) // rule.frames_per_window * rule.frames_per_window
    for events, start_us, end_us in reversed(cuts[:whole]):
        yield fill_window(events, lookup, rule, start_us, end_us).reversed()


def _cut(chunks: _OrderedChunks, rule: WindowRule) -> Iterator[Cut]:
    def time_us(frame: float) -> float:
        return start + frame * 1e6 / rule.fps

    def cut(k: int) -> Cut:
        since, to = time_us(rule.first_frame_of_window(k)), time_us(k)
        return events[count_before(events, since) : count_before(events, to)], since, to

    k, pending = 1, list[np.ndarray]()
    for chunk in chunks:
        start, end = chunks.first_us + 1e6 * np.array([rule.start_s, rule.end_s])
        if chunks.last_us < start:
            continue
        events = concatenate_events([*pending, chunk[count_before(chunk, start) :]])
        last = min(chunks.last_us + 1, end)
        while time_us(k) <= min(chunks.last_us, end):  # more events of that time may come
            yield cut(k)
            k += 1
        pending = [events[count_before(events, time_us(rule.first_frame_of_window(k))) :]]
        if last == end:
            break
    while pending and time_us(k - 1 + COVERED) <= last:
        yield cut(k)
        k += 1


def fill_window(
    events: np.ndarray, lookup: SensorLookup, rule: WindowRule, start_us: float, end_us: float
) -> Window:
    """Return the window [start_us, end_us) of `events`, which lie in it, as a grid or a list.

    Both are in events per sensor pixel, as in training, however views are resampled.
    """
    nearest, density = rule.splat == "nearest", lookup.density[rule.splat]
    keeps_state = rule.keeps_state(start_us, end_us)
    window = partial(Window, start_us, end_us, keeps_state=keeps_state)
    if rule.as_lists:
        (index, x, y, weight, view), outside = lookup.list_contributions(
            events, density, nearest=nearest
        )
        length_s = (end_us - start_us) * 1e-6
        t = np.clip((events["t"] - start_us) * 1e-6, 0, length_s)[index]
        listed = VoxelContributions(t, x, y, weight, view)
        count = len(events) - outside
        return window(events=count, events_outside=outside, event_list=listed)
    if not events.size:
        empty = np.broadcast_to(np.float32(0), (lookup.views, rule.bins, *lookup.model))
        return window(events=0, events_outside=0, voxels=empty)
    grid = lookup.empty_grid(rule.bins)
    outside = lookup.add_to_grid(events, grid, start_us, end_us, nearest=nearest)
    grid /= density
    return window(events=len(events) - outside, events_outside=outside, voxels=grid)
