"""What all times of a table tell before it is read: their unit, and whether they are in order."""

from collections.abc import Callable, Iterable
from typing import NamedTuple, TypeVar

import numpy as np

from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.event_file import (
    UNITS_US,
    EventFile,
    RawEvents,
    ReadOptions,
    name_file_in_errors,
)
from src.recordings.files.event_order import (
    BUFFER_US,
    FEW_EVENTS,
    FEW_SHARE,
    LEAST_FEW,
    MAX_DROPPED,
    EventSorter,
)
from src.recordings.files.time_unit import (
    TimeSample,
    check_times,
    describe_equal_times,
    find_unit,
    to_us,
)

LEAST_BUFFER_US, WIDER = 1000, 4  # of a short table; by which its buffer grows where that helps
LARGEST_BUFFER_US = 3_200_000  # of a table, which is sorted by frames of less
KEPT_BYTES = 2**28  # of what was read for its times and need not be read again
Part = TypeVar("Part", np.ndarray, RawEvents)


class TimeSurvey(NamedTuple):
    """The unit of the times, the buffer and the least events of a part (EventSorter), whether the
    two parts are ON and OFF, and lines for the user.

    `covers_all_times`: all times were looked at; else they are while the file is read.
    `is_ordered`: they are in order and of one clock.  `wrap_bits`: of a counter that goes round, 0
    for none.  `times` or `pieces`: what was read for this
    and is little enough to be kept.
    """

    unit: str
    buffer_us: int = BUFFER_US
    min_part_events: int = FEW_EVENTS
    parts_are_on_and_off: bool = False
    messages: tuple[str, ...] = ()
    covers_all_times: bool = True
    is_ordered: bool = False
    wrap_bits: int = 0
    times: list[np.ndarray] | None = None
    pieces: list[RawEvents] | None = None


def survey_times(file: EventFile, options: ReadOptions) -> TimeSurvey:
    """Return what the times of a file tell where its format does not define their unit, or where
    they can be read alone.

    Raises ValueError, which names the file, for one that is refused (sort_with_smallest_buffer).
    """
    times = pieces = None
    if file.times() is not None:
        times = file.kept_times = _keep(lambda: file.times() or ())
    elif file.time_unit is None:
        pieces = _keep(file.pieces)
    else:
        return TimeSurvey(file.time_unit, covers_all_times=False)

    def read_times() -> Iterable[np.ndarray]:
        return times or file.times() or (piece.t for piece in pieces or file.pieces())

    return _judge(file, options, read_times)._replace(times=times, pieces=pieces)


def _judge(
    file: EventFile, options: ReadOptions, read_times: Callable[[], Iterable[np.ndarray]]
) -> TimeSurvey:
    path, sample = file.path, TimeSample()
    for t in read_times():
        sample.add(t)
    bits = sample.wrap_bits
    if file.time_unit is not None:
        unit, line = file.time_unit, describe_equal_times(sample)
    else:
        try:
            unit, line = find_unit(sample, options.time_unit)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def read_us() -> Iterable[np.ndarray]:
        clock = TimestampUnwrapper(bits) if bits else None
        for t in read_times():
            check_times(t, unit, path)
            yield to_us(t if clock is None else clock.unwrap(t), unit)

    span_us = sample.early_time_and_span()[1] * UNITS_US[unit]
    with name_file_in_errors(path, "its times cannot be read"):
        order = sort_with_smallest_buffer(read_us, sample.count, span_us)
    order.check_part(options.part or 0, path)
    lines = [f"{path}: {line}"] if line else []
    if bits:
        lines.append(f"{path}: its counter of {bits} bits goes round, times go on")
    merged = options.part is None and len(order.parts) == 2
    if merged and _is_on_then_off(file, order.parts[0].count, order.parts[-1].count, sample.count):
        lines.append(f"{path}: all events of one polarity come before the others, sorted by time")
    else:
        merged = False
        lines += order.describe_time_faults(path, part=options.part)
    shape = order.buffer_us, order.min_part_events, merged
    ordered = order.is_in_order()
    return TimeSurvey(unit, *shape, tuple(lines), is_ordered=ordered, wrap_bits=bits)


def sort_with_smallest_buffer(
    read_times: Callable[[], Iterable[np.ndarray]], count: int, span_us: float
) -> EventSorter:
    """Return the EventSorter, of the smallest buffer that is enough, that took all times of a file.

    `read_times` yields them, int64 us, from the beginning each time; `count` and `span_us` are of
    the file.  The buffer is an eighth of the span, in LEAST_BUFFER_US..BUFFER_US, and grows up to
    LARGEST_BUFFER_US where more than MAX_DROPPED are late: a file that goes pixel by pixel within
    frames is sorted.  Raises ValueError for a file that is refused.
    """
    buffer_us = int(min(max(span_us / 8, LEAST_BUFFER_US), BUFFER_US))
    min_part_events, fault, best = min(FEW_EVENTS, max(LEAST_FEW, count // FEW_SHARE)), "", None
    while buffer_us <= LARGEST_BUFFER_US:
        order = EventSorter(buffer_us, min_part_events)
        for t in read_times():
            order.add(t)
        order.finish()
        if (found := order.reason_to_refuse()) is not None:
            fault = found
        elif best is None or order.dropped < best.dropped:
            best = order
        if best and (not best.dropped or best.late <= MAX_DROPPED * best.count):
            break
        buffer_us *= WIDER
    if best is None:
        raise ValueError(f"{fault}, it must be sorted first")
    return best


def _is_on_then_off(file: EventFile, first: int, last: int, count: int) -> bool:
    """Return whether the `first` events of `count` have one polarity, the `last` ones another."""
    at, found = 0, [set[bool](), set[bool]()]
    for piece in file.pieces():
        is_on = np.asarray(piece.p) > 0
        place = at + np.arange(len(is_on))
        for signs, chosen in zip(found, (place < first, place >= count - last), strict=True):
            signs.update(np.unique(is_on[chosen]).tolist())
        if max(map(len, found)) > 1:
            return False
        at += len(is_on)
    return found[0] != found[1]


def _keep(read: Callable[[], Iterable[Part]]) -> list[Part] | None:
    """Return all that is read; None for more than KEPT_BYTES."""
    kept, size = [], 0
    for part in read():
        arrays = (part,) if isinstance(part, np.ndarray) else part
        size += sum(array.nbytes for array in arrays)
        if size > KEPT_BYTES:
            return None
        kept.append(part)
    return kept
