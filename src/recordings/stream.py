"""Events of any length to windows of voxel grids to frames, in memory that does not grow.

Windows are cut by time, one frame every 1 / fps seconds, or by a count of events.  Times are
microseconds of the recording's clock in float64, frames carry seconds.

How the voxel scale is handled at high frame rates.  A network trained on windows of 1/120 s that is
fed windows of 1/12000 s sees a hundredth of the events and runs its recurrence a hundred times as
often: it fades.  So `span` windows overlap: each is round(trained * fps) frames long and is fed to
the recurrent state of the window that ended where it starts.  Every one of these interleaved phases
is exactly the reconstruction at the trained rate, and every event counts once per phase.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, cycle
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from src.models.look_ahead import checked
from src.models.unroll import accepted, takes
from src.recordings.files.event_arrays import joined, until
from src.recordings.lookup import Lookup

COVERED = 0.99  # of the last window, or the recording ends before it


@dataclass(frozen=True)
class Window:
    """The voxel grid of the events in [start_us, end_us): `events` in views, `outside` in none.

    `parts`, instead of a grid: seconds since the start, x, y, weight and view of all that a network
    without a grid adds up (`Runtime`).
    """

    start_us: float
    end_us: float
    events: int
    outside: int
    voxels: Float[np.ndarray, "views bins h w"] | None = None
    parts: tuple[np.ndarray, ...] = ()

    @property
    def seconds(self) -> float:
        """How long the window lasts."""
        return (self.end_us - self.start_us) * 1e-6

    def reversed(self) -> "Window":
        """Return the window with its events backwards in time: last first, polarity the other."""
        if self.voxels is not None:
            return replace(self, voxels=-self.voxels[:, ::-1])
        t, x, y, weight, view = (part[::-1] for part in self.parts)
        return replace(self, parts=(self.seconds - t, x, y, -weight, view))


@dataclass(frozen=True)
class Rule:
    """How windows are cut: by time, `overlap` windows over each other, or by `count` of events.

    `unit`: a grid holds events per sensor `pixel`, as in training whatever the resampling, or all
    their `mass`.  A window by time is overlap / fps long and ends 1 / fps after the one before it.
    `start_s` and `end_s` count from the recording's first event.  `grids`: windows hold a voxel
    grid; else the parts of one.
    """

    fps: float | None = None
    count: int | None = None
    overlap: int = 1
    bins: int = 5
    splat: str = "bilinear"
    unit: str = "pixel"
    start_s: float = 0.0
    end_s: float = float("inf")
    grids: bool = True

    def __post_init__(self):
        if (self.fps is None) == (self.count is None):
            raise ValueError(f"give either fps or count, got fps={self.fps} count={self.count}")
        if self.fps is not None and not 0 < self.fps <= 1e6:
            raise ValueError(f"fps must be in (0, 1e6], got {self.fps}")
        if self.count is not None and self.count < 1:
            raise ValueError(f"count must be >= 1, got {self.count}")
        if self.splat not in ("bilinear", "nearest"):
            raise ValueError(f"splat must be bilinear or nearest, got {self.splat}")
        if self.unit not in ("pixel", "mass"):
            raise ValueError(f"unit must be pixel or mass, got {self.unit}")
        if self.overlap < 1 or self.bins < 1:
            raise ValueError(f"overlap and bins must be >= 1, got {self.overlap} and {self.bins}")
        if not 0 <= self.start_s < self.end_s:
            raise ValueError(f"start must be >= 0 and before end, got {self.start_s}, {self.end_s}")


def overlap(span: str, fps: float, trained_s: float = 1 / 120) -> int:
    """Return how many frames a window spans: `frame` one; `trained` the trained length, if longer.

    Raises ValueError for another `span`.
    """
    if span not in ("frame", "trained"):
        raise ValueError(f"span must be frame or trained, got {span}")
    return max(1, round(trained_s * fps)) if span == "trained" else 1


def windows(chunks: Iterable[np.ndarray], lookup: Lookup, rule: Rule) -> Iterator[Window]:
    """Cut chunks of events (fields t x y p, in order of time) into windows by `rule`.

    Raises ValueError for time running backwards, an event off the sensor, or a recording that is
    shorter than one window.
    """
    ordered = _ordered(chunks, lookup)
    first, window = next(ordered, None), None
    if first is not None:
        start, end = first["t"][0] + 1e6 * np.array([rule.start_s, rule.end_s])
        later = (chunk[until(chunk, start) :] for chunk in chain([first], ordered))
        cut = _by_time if rule.count is None else _by_count
        for window in cut(filter(len, later), lookup, rule, start, end):
            yield window
    if window is None:
        length = f"1/{rule.fps} s" if rule.count is None else f"{rule.count} events"
        raise ValueError(f"recording must be longer than one window of {length}, got less")


def backwards(
    chunks: Iterable[np.ndarray], lookup: Lookup, rule: Rule, seconds: float
) -> Iterator[Window]:
    """Yield the windows by time of the first `seconds`, the last first, each `reversed`.

    As many as are a multiple of the rule's `overlap`, so that `Carry.turn` gives every phase its
    state.  Holds the events of these seconds.  Raises ValueError as `windows`, for windows by count
    and for seconds that are no length of time.
    """
    if rule.fps is None:
        raise ValueError(f"look_ahead_s must be 0 with count={rule.count}: it wants windows by fps")
    ordered, period = _ordered(chunks, lookup), 1e6 / rule.fps
    first = next(ordered, None)
    if first is None:
        return
    start = first["t"][0] + 1e6 * rule.start_s
    end = start + 1e6 * min(checked(seconds), rule.end_s - rule.start_s)
    held = []
    for chunk in chain([first], ordered):
        held.append(chunk[until(chunk, start) :])
        if chunk["t"][-1] >= end:
            break
    events = joined(held)
    last = min(end, float(chunk["t"][-1]) + 1)
    whole = int((last - start) / period + 1 - COVERED)
    for k in range(whole // rule.overlap * rule.overlap, 0, -1):
        yield _window(events, lookup, rule, start, k).reversed()


def _ordered(chunks: Iterable[np.ndarray], lookup: Lookup) -> Iterator[np.ndarray]:
    last = None
    for chunk in filter(len, chunks):
        t = chunk["t"]
        if (np.diff(t) < 0).any() or (last is not None and t[0] < last):
            raise ValueError(
                "recording must not run backwards in time, an event is before the last"
            )
        last = t[-1]
        lookup.check(chunk)
        yield chunk


def _by_time(
    chunks: Iterable[np.ndarray], lookup: Lookup, rule: Rule, start: float, end: float
) -> Iterator[Window]:
    period, k, last = 1e6 / rule.fps, 1, start
    pending = None
    for chunk in chunks:
        pending = chunk if pending is None else joined([pending, chunk])
        last = min(float(chunk["t"][-1]) + 1, end)
        while start + k * period < last:
            yield _window(pending, lookup, rule, start, k)
            k += 1
        oldest = start + (k - rule.overlap) * period
        pending = pending[until(pending, oldest) :]
        if last == end:
            break
    while start + (k - 1 + COVERED) * period <= last:
        yield _window(pending, lookup, rule, start, k)
        k += 1


def _window(events: np.ndarray, lookup: Lookup, rule: Rule, start: float, k: int) -> Window:
    end = start + k * 1e6 / rule.fps
    begin = start + (k - rule.overlap) * 1e6 / rule.fps
    inside = slice(until(events, begin), until(events, end))
    return filled(events[inside], lookup, rule, begin, end)


def filled(events: np.ndarray, lookup: Lookup, rule: Rule, begin: float, end: float) -> Window:
    """Return the window [begin, end) us of `events`, which lie in it, filled as `rule` says."""
    if not rule.grids:
        return _listed(events, lookup, rule, begin, end)
    if not events.size:
        nothing = np.broadcast_to(np.float32(0), (lookup.views, rule.bins, *lookup.model))
        return Window(begin, end, 0, 0, nothing)
    grid = lookup.empty(rule.bins)
    outside = lookup.add(events, grid, begin, end, nearest=rule.splat == "nearest")
    if rule.unit == "pixel":
        grid /= lookup.densities[rule.splat]
    return Window(begin, end, len(events) - outside, outside, grid)


def _listed(events: np.ndarray, lookup: Lookup, rule: Rule, begin: float, end: float) -> Window:
    density = lookup.densities[rule.splat] if rule.unit == "pixel" else lookup.unit
    parts, outside = lookup.parts(events, density, nearest=rule.splat == "nearest")
    seconds = np.clip((events["t"] - begin) * 1e-6, 0, (end - begin) * 1e-6)
    parts = (seconds[parts[0]], *parts[1:])
    return Window(begin, end, len(events) - outside, outside, parts=parts)


def _by_count(
    chunks: Iterable[np.ndarray], lookup: Lookup, rule: Rule, begin: float, end: float
) -> Iterator[Window]:
    pending = None
    for chunk in chunks:
        early = chunk[: until(chunk, end)]
        pending = early if pending is None else joined([pending, early])
        inside = np.flatnonzero(lookup.view[pending["y"], pending["x"]] >= 0)
        stop = 0
        for nth in inside[rule.count - 1 :: rule.count]:
            events, stop = pending[stop : nth + 1], nth + 1
            last = max(float(events["t"][-1]), begin + 1.0)
            yield filled(events, lookup, rule, begin, last)
            begin = last
        pending = pending[stop:]
        if len(early) < len(chunk):
            return


@dataclass
class Carry:
    """What lives from frame to frame: a recurrent state per phase, the picture, frames so far."""

    states: list[Any] = field(default_factory=list)
    picture: Float[np.ndarray, "h w"] | None = None
    frames: int = 0

    def turn(self) -> None:
        """After windows `backwards`, be ready for the same windows forwards."""
        self.states.reverse()
        self.frames = 0


def each_view(
    windows: Iterable[Window], network: nn.Module, *, overlap: int = 1
) -> Iterator[Float[np.ndarray, "views h w"]]:
    """Reconstruct every view by itself, with a network of one view; empty windows hold."""
    states, pictures = [None] * overlap, None
    for window, phase in zip(windows, cycle(range(overlap)), strict=False):
        if window.events or pictures is None:
            options = accepted(network, window_s=window.seconds, positions=[(0, 0)])
            voxels = torch.from_numpy(window.voxels.copy())[:, None]
            with torch.inference_mode():
                pictures, states[phase] = network(voxels, states[phase], **options)
        yield pictures[:, 0].clamp(0, 1).numpy()


@dataclass(frozen=True)
class Frame:
    """A picture (h, w) float32 in [0, 1] at `time_s`, the end of its window, and its events."""

    time_s: float
    picture: Float[np.ndarray, "h w"]
    events: int
    outside: int


def wanted(network: nn.Module, views: int) -> bool:
    """Return whether `network` takes all `views`; False: it takes the centre view alone.

    Raises ValueError where it wants another number of views.
    """
    wants = getattr(network, "views", None)
    if wants not in (None, 1, views):
        raise ValueError(
            f"ckpt wants {wants} views, the recording has {views}; give views=views.yaml"
        )
    return wants != 1 or views == 1


def default_span(network: nn.Module) -> str:
    """Return `frame` for a network that is told the length of its window, else `trained`: fed
    shorter windows than in training, most fade (docs/decisions/0005-recordings.md).
    """
    return "frame" if takes(network, "window_s") else "trained"


def frames(
    windows: Iterable[Window],
    network: nn.Module,
    *,
    overlap: int = 1,
    positions: Sequence[tuple[int, int]] | None = None,
    device: torch.device | str = "cpu",
    carry: Carry | None = None,
) -> Iterator[Frame]:
    """Reconstruct one frame per window; a window without events holds the picture at no cost.

    `overlap` is that of the windows' rule: the window k continues the state of window k - overlap.
    A network that takes `window_s` and `positions` is given them.  `carry` of an earlier call makes
    this one its continuation (law 6); it is kept up to date.
    """

    def step(window: Window, state: Any) -> tuple[np.ndarray, Any]:
        options = accepted(network, window_s=window.seconds, positions=positions)
        voxels = torch.from_numpy(window.voxels)[None].to(device)
        with torch.inference_mode():
            picture, state = network(voxels, state, **options)
        return picture[0, 0].float().cpu().numpy(), state

    return carried(windows, step, None, overlap, carry)


def carried(
    windows: Iterable[Window],
    step: Callable[[Window, Any], tuple[np.ndarray, Any]],
    size: tuple[int, int] | None,
    overlap: int,
    carry: Carry | None,
) -> Iterator[Frame]:
    """Yield a frame per window, made by `step` of a window with events and the state of its phase;
    `size`: of a picture before any event, None: of a window's grid.
    """
    carry = Carry() if carry is None else carry
    carry.states.extend([None] * (overlap - len(carry.states)))
    for window in windows:
        phase = carry.frames % overlap
        if window.events:
            picture, carry.states[phase] = step(window, carry.states[phase])
            carry.picture = picture.clip(0, 1)
        elif carry.picture is None:
            carry.picture = np.full(size or window.voxels.shape[-2:], 0.5, np.float32)
        carry.frames += 1
        yield Frame(window.end_us * 1e-6, carry.picture, window.events, window.outside)
