"""One rule for events that come out of order, in files and live.

Events up to `buffer_us` late are sorted, in their order where times are equal.  Fewer than
`min_part_events` events with times further from those around them are outliers: dropped and
counted.  More of them earlier are a clock that restarts and begin another part, as do those that
are later by more than an hour; other later ones are a silence.  A file is refused where more than
MAX_DROPPED of its events are outliers, or its clock restarts more than MAX_PARTS times.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from src.recordings.engines.event_passes import (
    KEPT,
    LONG_AGO_US,
    LONGEST_SILENCE_US,
    MAX_TIME_US,
    label_kept_or_dropped,
)
from src.recordings.files.event_arrays import (
    concatenate_events,
    count_before,
    event_times,
    sort_events,
)

BUFFER_US = 50_000  # by which events may be late
BUFFER_EVENTS = 2**24  # that are buffered at most; of more the oldest go
FEW_EVENTS, LEAST_FEW, FEW_SHARE = 256, 4, 100  # a hundredth of a file, within these bounds
MAX_DROPPED = 0.01
MAX_PARTS = 100
BACKWARD = 0.9  # of the events that come after a later one, and of the steps between events
TOLD_US = 1000  # events later than that are told of


@dataclass
class ClockPart:
    """Events of one clock: how many, and the first and the last time in us."""

    count: int = 0
    first_us: int = 0
    last_us: int = LONG_AGO_US


class EventSorter:
    """Takes events (n,) EVENT, or times (n,) int64 us alone, as they come; gives them in order.

    `kept_part`: the number of the one part that is given, 0 the first; newest: always the last, of
    which no event goes before `release` is called (live).  `parts`, `dropped`, `late` (events that
    were sorted) and `most_late_us` tell what was found.
    """

    def __init__(
        self, buffer_us: int = BUFFER_US, min_part_events: int = FEW_EVENTS,
        kept_part: int | Literal["newest"] = 0,
    ):  # fmt: skip
        self.buffer_us, self.min_part_events = buffer_us, min_part_events
        self._kept_part = kept_part
        self._is_live = kept_part == "newest"
        self.parts, self.count = [ClockPart()], 0
        self.dropped = self.late = self.most_late_us = 0
        self._last_dropped, self._last_gap_us = 0, 0  # events at the end, the silence before
        self._rises = self._falls = 0  # steps among events that come out of order
        self._undecided: np.ndarray | None = None
        self._held: list[np.ndarray] = []  # in order, one after the other
        self._released_us = LONG_AGO_US

    @property
    def last_us(self) -> int:
        """Return the latest time that is no outlier."""
        return self.parts[-1].last_us

    @property
    def first_held_us(self) -> int | None:
        """Return the earliest time of what is in order and not given yet; None where nothing is."""
        return int(event_times(self._held[0])[0]) if self._held else None

    def add(self, events: np.ndarray) -> list[np.ndarray]:
        """Take events; return those that are in order for good."""
        start = 2 * self.min_part_events
        if self.parts[-1].count < self.min_part_events and len(events) > 2 * start:
            return [*self.add(events[:start]), *self.add(events[start:])]
        self.count += len(events)
        if self._undecided is not None:
            events = concatenate_events([self._undecided, events])
        return self._decide(events, self.min_part_events, at_end=False)

    def finish(self) -> list[np.ndarray]:
        """Return the events that are left, after the last."""
        least = min(self.min_part_events, max(LEAST_FEW, self.count // FEW_SHARE))
        undecided, ready = self._undecided, []
        if undecided is not None:
            before, gap_us = self.dropped, int(event_times(undecided).min()) - self.last_us
            ready = self._decide(undecided, least, at_end=True)
            if gap_us > 0 and self.dropped == before + len(undecided):
                self._last_dropped, self._last_gap_us = len(undecided), gap_us
        return [*ready, *self.release(2**63 - 1)]

    def accept_events_after_gap(self, until_us: float) -> None:
        """Take later events for a silence's end, without waiting for more, if before `until_us`."""
        waiting = self._undecided
        if waiting is not None and self.last_us < event_times(waiting).min() <= until_us:
            self._decide(waiting, self.min_part_events, at_end=True)

    def release(self, until_us: float) -> list[np.ndarray]:
        """Return the events before `until_us`; what comes later and is earlier is dropped."""
        ready: list[np.ndarray] = []
        while self._held and event_times(self._held[0])[-1] < until_us:
            ready.append(self._held.pop(0))
        if self._held and (cut := count_before(self._held[0], until_us)):
            ready.append(self._held[0][:cut])
            self._held[0] = self._held[0][cut:]
        self._released_us = max(self._released_us, math.ceil(min(until_us, MAX_TIME_US)))
        return ready

    def _decide(self, events: np.ndarray, least: int, *, at_end: bool) -> list[np.ndarray]:
        ready: list[np.ndarray] = []
        while len(events):
            if self._goes_on(events, least):
                ready += self._keep(events, are_in_order=True)
                events = events[:0]
                break
            part, labels = self.parts[-1], np.empty(len(events), np.int8)
            t = np.ascontiguousarray(event_times(events))
            state = part.first_us, part.last_us, part.count
            done, _, _, restarted = label_kept_or_dropped(
                t, *state, self.buffer_us, least, at_end, labels
            )
            kept = labels[:done] == KEPT
            self.dropped += int(done - kept.sum())
            ready += self._keep(events[:done] if kept.all() else events[:done][kept])
            events = events[done:]
            if not restarted:
                break
            ready += self._restart(least)
        self._undecided = events if len(events) else None
        return ready

    def _goes_on(self, events: np.ndarray, least: int) -> bool:
        """Return whether all events are in order, without a silence that is too long, and none of
        the last ones could be an outlier."""
        t, part = event_times(events), self.parts[-1]
        if part.count < least or len(t) <= least or t[0] < part.last_us:
            return False
        steps = np.diff(t, prepend=part.last_us)
        is_near = steps[-least:].max() <= self.buffer_us
        return bool(is_near and steps.min() >= 0 and steps.max() <= LONGEST_SILENCE_US)

    def _keep(self, events: np.ndarray, *, are_in_order: bool = False) -> list[np.ndarray]:
        """Hold events of the part's clock; return those that are in order for good."""
        if not len(events):
            return []
        part, t = self.parts[-1], event_times(events)
        if not are_in_order:
            late_us = np.maximum.accumulate(np.maximum(t, part.last_us)) - t
            are_in_order = not late_us.any()
        if not are_in_order:
            self._rises += int(np.count_nonzero(t[1:] > t[:-1]))
            self._falls += int(np.count_nonzero(t[1:] < t[:-1]))
            self.late += int(np.count_nonzero(late_us))
            self.most_late_us = max(self.most_late_us, int(late_us.max()))
        if not are_in_order or t[0] < self._released_us:
            is_gone = t < self._released_us
            self.dropped += int(is_gone.sum())
            events = events[~is_gone] if is_gone.any() else events
        part.first_us = part.first_us if part.count else int(t[0])
        part.last_us = max(part.last_us, int(t.max()))
        part.count += len(t)
        if not self._is_live and self._kept_part != len(self.parts) - 1:
            return []
        self._hold(events, not are_in_order)
        if self._is_live or part.count < self.min_part_events:
            return []
        return self.release(self._bound_us(part.last_us - self.buffer_us))

    def _hold(self, events: np.ndarray, unsorted: bool) -> None:
        if unsorted and len(events):
            first = event_times(events).min()
            after = [part for part in self._held if event_times(part)[-1] > first]
            self._held = self._held[: len(self._held) - len(after)]
            events = sort_events(concatenate_events([*after, events]))
        if len(events):
            self._held.append(events)

    def _bound_us(self, until_us: int) -> int:
        """Return `until_us`, or a later time where more than BUFFER_EVENTS would be held."""
        excess = sum(map(len, self._held)) - BUFFER_EVENTS
        for part in self._held:
            if excess < 0:
                break
            until_us = max(until_us, int(event_times(part)[min(excess, len(part) - 1)]))
            excess -= len(part)
        return until_us

    def _restart(self, least: int) -> list[np.ndarray]:
        """Begin another part; too few events of one before it are outliers."""
        ready, self._released_us = [], LONG_AGO_US
        if self.parts[-1].count < least:
            self.dropped += self.parts.pop().count
        elif not self._is_live:
            ready = self.release(2**63 - 1)
            self._released_us = LONG_AGO_US
        self._held = []
        self.parts.append(ClockPart())
        return ready

    def is_in_order(self) -> bool:
        """Return whether all events came in order and of one clock."""
        return not (self.late or self.dropped) and len(self.parts) == 1

    def reason_to_refuse(self) -> str | None:
        """Return why a file like this cannot be read as it is; None where it can."""
        if self.dropped > max(1, MAX_DROPPED * self.count):
            share = f"{100 * self.dropped / self.count:.3g} % of {self.count} events"
            return f"{share} are more than {self.buffer_us * 1e-6:g} s out of order of time"
        steps = self._rises + self._falls
        if len(self.parts) > 1 and self._falls > BACKWARD * steps and (
            self.late > BACKWARD * self.count
        ):  # fmt: skip
            return "its times go backward from event to event"
        if len(self.parts) > MAX_PARTS:
            return f"its clock restarts more than {MAX_PARTS} times"
        return None

    def check_part(self, part: int, path: Path) -> None:
        """Raise ValueError where there is no such part."""
        most = len(self.parts) - 1
        if part > most:
            raise ValueError(f"part must be in 0..{most}, the parts of {path}, got {part}")

    def describe_time_faults(self, path: Path, *, part: int | None) -> Iterator[str]:
        """Yield what the user is told; `part`: the one that was asked for."""
        last, far = self._last_dropped, self.dropped - self._last_dropped
        if far:
            yield f"{path}: {far} of {self.count} events far out of order of time, dropped"
        if last:
            silence = f"after a silence of {self._last_gap_us * 1e-6:.3g} s"
            yield f"{path}: the last {last} of {self.count} events {silence}, dropped"
        if self.most_late_us > TOLD_US:
            reach = f"up to {self.most_late_us * 1e-6:.3g} s"
            yield f"{path}: {self.late} of {self.count} events {reach} out of order, sorted"
        if len(self.parts) > 1 and part is None:
            why = "its clock restarts or leaps by more than an hour"
            lengths = ", ".join(
                f"{k}: {one.count} events, {(one.last_us - one.first_us) * 1e-6:.3g} s"
                for k, one in enumerate(self.parts[:10])
            )
            yield f"{path}: {why}, part=0 of {len(self.parts)} is read ({lengths})"


def merge_in_time(ones: Iterator[np.ndarray], others: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """Yield the events of two recordings, each in order of time, in order."""
    one, other = next(ones, None), next(others, None)
    while one is not None and other is not None:
        until = int(min(one["t"][-1], other["t"][-1])) + 1
        cut, cut_other = count_before(one, until), count_before(other, until)
        both = concatenate_events([one[:cut], other[:cut_other]])
        yield sort_events(both)
        one = one[cut:] if cut < len(one) else next(ones, None)
        other = other[cut_other:] if cut_other < len(other) else next(others, None)
    for rest, left in ((one, ones), (other, others)):
        if rest is not None:
            yield rest
            yield from left
