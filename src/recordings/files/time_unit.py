"""The unit of a table's times, told once by all of them, and times in it to int64 microseconds.

A unit is judged by the file's duration and event rate in it.  It loses a point for each factor of
ten by which the duration is outside 0.02 s..600 s or the rate outside 3e3..3e6 events/s, and those
of PRIOR, for whole numbers and others; ns lose NS_OF_US where all are apart by thousands.  It gains
EPOCH where the times are then dates of 2001 to 2039 and loses EPOCH where they are later.  Where
half of the times have more than three digits behind the point, other units than s lose FINE: they
would be finer than a camera's.
The duration is that between the 1st and the 99th of a hundred times, so that single wild ones do
not matter, the rate that of the median step, so that silence does not; a counter that goes round
goes on.

The best unit is taken.  The user is told where it is not that of PRIOR 0 or a date, where a second
one is less than NEAR behind, where another would be ahead but for FINE though the times are finer
than a camera's in s, too, where us need more events/s than usual and ms would be ahead but for
PRIOR, and where duration or rate are absurd.  Fewer than FEW_TIMES values tell too little: they are
dates where one unit makes them so, else seconds with a fraction, microseconds without.

Whole numbers that are dates in ms are also us of a clock that has run for 12 to 25 days, and dates
in us, all apart by thousands, ns of such a clock: duration and rate alone decide, the user is told,
and asked where the two are less than CLEAR apart.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from src.recordings.engines.event_passes import MAX_TIME_US
from src.recordings.files.clocks import NEARLY_A_TURN, TimestampUnwrapper
from src.recordings.files.event_file import UNITS_US

PRIOR = {
    True: {"us": 0.0, "ns": 2.0, "ms": 2.0, "s": 3.0},  # whole numbers
    False: {"s": 0.0, "ms": 1.0, "us": 1.0, "ns": 2.0},
}
FINE, NS_OF_US = 3.0, 0.8
DURATION_S, RATE_HZ, EPOCH_S, EPOCH = (0.02, 600.0), (3e3, 3e6), (1e9, 2.2e9), 3.0
NEAR = 1.25  # points: a second unit as near is told of
CLEAR = 1.5  # points by which a date or a clock that has run for days is taken
ABSURD_S, ABSURD_HZ = (1e-3, 86_400.0), (10.0, 1e9)  # outside, duration and rate are told of
FEW_TIMES = 100
SAMPLES = 1024  # of a piece
COUNTER_BITS = (24, 31, 32)  # of counters that go round
Range = tuple[float, float]


class TimeSample:
    """Some of a file's times in its unit, from all its pieces, and what all of them are: whole
    numbers, numbers apart by thousands, a counter of `wrap_bits` that goes round (0: none)."""

    def __init__(self) -> None:
        self.count, self.are_whole_numbers, self.are_apart_by_thousands = 0, True, True
        self._values: list[np.ndarray] = []
        self._last: Any = None
        self._most_fall = 0
        self._most_rise = dict.fromkeys(COUNTER_BITS, 0)  # but of late events of such a counter
        self._first_fall: int | None = None  # the place of a time that far below the one before
        self._range: Range = (np.inf, -np.inf)

    def add(self, t: np.ndarray) -> None:
        """Take the times (n,) of a piece."""
        if not len(t):
            return
        first = t[0] if self._last is None else self._last
        values = np.array(t[:: max(1, len(t) // SAMPLES)])
        self._values.append(values)
        if t.dtype.kind == "f":
            if self.are_whole_numbers:
                self.are_whole_numbers = bool((t == np.rint(t)).all())
        else:
            self._range = _widen(self._range, t)
            self._add_steps(np.diff(t, prepend=first))
        if self.are_apart_by_thousands:
            self.are_apart_by_thousands = not (np.diff(values, prepend=first) % 1000).any()
        self._last, self.count = t[-1], self.count + len(t)

    def _add_steps(self, steps: np.ndarray) -> None:
        """Take the steps (n,) to the times of a piece of whole numbers."""
        self._most_fall = min(self._most_fall, int(steps.min()))
        is_fall = steps < -NEARLY_A_TURN * 2 ** COUNTER_BITS[0]
        if self._first_fall is None and is_fall.any():
            self._first_fall = self.count + int(is_fall.argmax())
        start = len(steps) if self._first_fall is None else max(0, self._first_fall - self.count)
        for bits, most in self._most_rise.items():
            is_late = steps[start:] >= NEARLY_A_TURN * 2**bits
            rises = [steps[:start].max(initial=0), steps[start:].max(initial=0, where=~is_late)]
            self._most_rise[bits] = max(most, *map(int, rises))

    @property
    def wrap_bits(self) -> int:
        """Return of how many bits a counter is that falls from its end to its beginning and goes on
        from there; else 0."""
        least, most = self._range
        follow = 0 if self._first_fall is None else self.count - self._first_fall
        if follow < FEW_TIMES or self._last == least:  # at the end may be zeros
            return 0
        for bits in COUNTER_BITS:
            turn, rise = 2**bits, self._most_rise[bits]
            has_fallen = self._most_fall < -NEARLY_A_TURN * turn
            if most - least < turn and has_fallen and rise < 0.5 * turn:
                return bits
        return 0

    def has_more_decimals(self, digits: int) -> bool:
        """Return whether half of the times or more have above `digits` behind the point."""
        if self.are_whole_numbers or not self._values:
            return False
        shifted = np.concatenate(self._values) * 10**digits
        return bool(np.mean(np.abs(shifted - np.rint(shifted)) > 1e-3) >= 0.5)

    def median_event_interval(self) -> float:
        """Return the median time from an event to the next, in the file's unit."""
        steps = np.diff(self._in_order())
        return float(np.median(steps)) * (len(steps) + 1) / self.count if len(steps) else 0.0

    def early_time_and_span(self) -> tuple[float, float]:
        """Return an early time and the span of the times, less the first and last hundredth, in the
        file's unit."""
        order = self._in_order()
        if not len(order):
            return 0.0, 0.0
        if self.count < FEW_TIMES:
            return float(order[0]), float(order[-1] - order[0])
        low, high = order[len(order) // 100], order[-1 - len(order) // 100]
        return float(low), float(high - low) / 0.98

    def _in_order(self) -> np.ndarray:
        values = np.concatenate(self._values) if self._values else np.zeros(0)
        if self.wrap_bits:
            values = TimestampUnwrapper(self.wrap_bits).unwrap(values)
        return np.sort(values[np.isfinite(values)])


class _Reading:
    """What a file's times are in a unit: its duration, its event rate, whether they are dates."""

    def __init__(self, count: int, early: float, span: float, interval: float, unit: str):
        early_s, self.duration_s, interval_s = (
            value * UNITS_US[unit] * 1e-6 for value in (early, span, interval)
        )
        self.rate_hz = count / self.duration_s if self.duration_s else np.inf
        self.active_rate_hz = 1 / interval_s if interval_s else self.rate_hz
        self.is_date = EPOCH_S[0] < early_s < EPOCH_S[1]
        self.is_later = early_s >= EPOCH_S[1]

    def __str__(self) -> str:
        return f"{self.duration_s:.3g} s and {self.rate_hz:.3g} events/s"

    def points(self) -> float:
        if not self.duration_s:
            return 0.0
        lost = _decades(self.duration_s, DURATION_S) + _decades(self.active_rate_hz, RATE_HZ)
        return EPOCH * (self.is_date - self.is_later) - lost


def find_unit(sample: TimeSample, stated: str) -> tuple[str, str]:
    """Return the unit (`stated`, where it is not auto), and what the user is told of it, or "".

    Raises ValueError for times that may be dates in one unit or of a clock in another.
    """
    is_auto = stated == "auto"
    usual = ("us" if sample.are_whole_numbers else "s") if is_auto else stated
    early, span = sample.early_time_and_span()
    seen = sample.count, early, span, sample.median_event_interval()
    read = {unit: _Reading(*seen, unit) for unit in UNITS_US}
    if sample.count < FEW_TIMES:
        dated = [unit for unit in UNITS_US if read[unit].is_date] if is_auto else []
        return (usual if usual in dated or not dated else dated[0]), ""
    if line := describe_equal_times(sample):
        return usual, line
    if is_auto and sample.are_whole_numbers:
        if read["ms"].is_date:
            return _choose_date_or_clock(read, "ms", "us")
        if read["us"].is_date and sample.are_apart_by_thousands:
            return _choose_date_or_clock(read, "us", "ns")
    losses, fine = dict(PRIOR[sample.are_whole_numbers]), FINE * sample.has_more_decimals(3)
    if sample.are_whole_numbers and sample.are_apart_by_thousands:
        losses["ns"] = NS_OF_US
    plain = {unit: read[unit].points() - losses[unit] for unit in UNITS_US}
    points = {unit: plain[unit] - fine * (unit != "s") for unit in UNITS_US}
    best, second = sorted(points, key=lambda unit: -points[unit])[:2]
    unit = best if is_auto else stated
    by_digits = max(plain.values()) > plain[unit] and sample.has_more_decimals(6)
    is_near = is_auto and (points[best] - points[second] < NEAR or by_digits)
    is_unusual = is_auto and PRIOR[sample.are_whole_numbers][unit] > 0 and not read[unit].is_date
    absurd = _decades(read[unit].duration_s, ABSURD_S) + _decades(read[unit].rate_hz, ABSURD_HZ)
    is_crowded = is_auto and sample.are_whole_numbers and unit == "us" and (
        read["us"].active_rate_hz > RATE_HZ[1] and read["ms"].points() > read["us"].points()
    )  # fmt: skip
    if not (is_near or is_unusual or is_crowded or absurd > 0):
        return unit, ""
    other = "ms" if is_crowded else second if unit == best else best
    if by_digits:
        other = max(plain, key=plain.__getitem__)
    return unit, _describe_choice(read, unit, other)


def _choose_date_or_clock(read: Mapping[str, _Reading], date: str, clock: str) -> tuple[str, str]:
    """Return the unit in which times are dates, or that of a clock that has run for days."""
    ahead = read[clock].points() - (read[date].points() - EPOCH)
    if abs(ahead) < CLEAR:
        raise ValueError(
            f"time_unit must be {date} or {clock}, got auto: times in {date} are dates and give"
            f" {read[date]}, in {clock} {read[clock]}"
        )
    unit, other = (clock, date) if ahead > 0 else (date, clock)
    return unit, _describe_choice(read, unit, other)


def _describe_choice(read: Mapping[str, _Reading], unit: str, other: str) -> str:
    both = f"times in {unit} give {read[unit]}, in {other} {read[other]}"
    return f"{both}: read as {unit}; if it is another, give time_unit=s, ms, us or ns"


def describe_equal_times(sample: TimeSample) -> str:
    """Return what the user is told where all times are equal or nearly all; else ""."""
    if sample.count < FEW_TIMES or sample.early_time_and_span()[1]:
        return ""
    return f"all or nearly all of {sample.count} times are equal"


def check_times(t: np.ndarray, unit: str, path: Path) -> None:
    """Raise ValueError for times (n,) that are not finite or beyond 2^62 us."""
    least, most = (t.min(), t.max()) if len(t) else (0, 0)
    bound = MAX_TIME_US / UNITS_US[unit]
    if not (-bound < float(least) and float(most) < bound):
        wrong = most if -bound < float(least) else least
        raise ValueError(f"{path}: times must be finite and within 2^62 us, got {wrong} {unit}")


def to_us(t: np.ndarray, unit: str) -> np.ndarray:
    """Return times (n,) of `unit` as int64 us, rounded; whole numbers exactly."""
    if t.dtype.kind == "f":
        return np.rint(t / 1e3 if unit == "ns" else t * UNITS_US[unit]).astype(np.int64)
    t = t.astype(np.int64, copy=False)
    if unit == "ns":
        return (t + 500) // 1000
    return t if unit == "us" else t * int(UNITS_US[unit])


def _decades(value: float, allowed: Range) -> float:
    """Return by how many factors of ten a value is outside."""
    if not 0 < value < np.inf:
        return np.inf
    return float(max(0.0, np.log10(allowed[0] / value), np.log10(value / allowed[1])))


def _widen(bounds: Range, values: np.ndarray) -> Range:
    return min(bounds[0], int(values.min())), max(bounds[1], int(values.max()))
