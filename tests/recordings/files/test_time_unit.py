"""The unit of times: told by all of a file's values, stated, or told of; whole numbers exactly."""

from pathlib import Path

import numpy as np
import pytest

from src.recordings.files.clocks import TimestampUnwrapper
from src.recordings.files.time_unit import TimeSample, check_times, find_unit, to_us

DATE_S = 1_600_000_000
PER_S = {"s": 1, "ms": 10**3, "us": 10**6, "ns": 10**9}


def sampled(t: np.ndarray, pieces: int = 3) -> TimeSample:
    sample = TimeSample()
    for part in np.array_split(t, pieces):
        sample.add(part)
    return sample


def made_up(duration_s: float, rate_hz: float) -> np.ndarray:
    """Return times in ns, int64."""
    g = np.random.default_rng(0)
    return np.sort(g.integers(0, int(duration_s * 1e9), int(duration_s * rate_hz)))


def in_unit(ns: np.ndarray, unit: str, date_s: int, kind: type) -> np.ndarray:
    if kind is float:
        return ns / (10**9 / PER_S[unit]) + date_s * PER_S[unit]
    return ns // (10**9 // PER_S[unit]) + date_s * PER_S[unit]


@pytest.mark.parametrize("first", [[], [0.0], [1e-06], [3600.0]])
@pytest.mark.parametrize(("duration", "rate"), [(0.2, 7500), (1.0, 1e4), (10.0, 2e4), (0.1, 1e6)])
def test_fractions_are_seconds_whatever_the_first_value(first, duration, rate):
    t = np.concatenate([first, in_unit(made_up(duration, rate), "s", 0, float)])
    assert find_unit(sampled(t), "auto") == ("s", "")


@pytest.mark.parametrize("kind", [int, np.round])
@pytest.mark.parametrize(("duration", "rate"), [(0.2, 7500), (1.0, 1e5), (10.0, 1e5), (0.1, 2e6)])
def test_whole_numbers_are_microseconds_with_a_point_or_without(kind, duration, rate):
    t = in_unit(made_up(duration, rate), "us", 0, int)
    t = t if kind is int else t.astype(float)
    assert find_unit(sampled(t), "auto") == ("us", "")


@pytest.mark.parametrize("kind", [int, float])
@pytest.mark.parametrize("unit", PER_S)
def test_dates_tell_their_unit(unit, kind):
    t = in_unit(made_up(2.0, 1e5), unit, DATE_S, kind)
    if unit != "s" or kind is float:  # whole seconds are not told from each other
        assert find_unit(sampled(t), "auto")[0] == unit


@pytest.mark.parametrize("start", [10**12, 2 * 10**12])  # us of 12 and 23 days, ms of 2001 and 2033
def test_a_clock_that_has_run_for_weeks_and_dates_in_milliseconds(start):
    for slower in (1, 60):
        t = in_unit(made_up(10.0, 1e5), "us", 0, int) * slower + start
        unit, line = find_unit(sampled(t), "auto")
        assert unit == "us" and "in ms " in line and "time_unit=" in line
    for duration, rate in ((2.0, 1e5), (10.0, 1e5), (0.1, 1e6)):
        unit, line = find_unit(
            sampled(in_unit(made_up(duration, rate), "ms", 0, int) + start), "auto"
        )
        assert unit == "ms" and "in us " in line and "time_unit=" in line


@pytest.mark.parametrize(("unit", "duration", "rate"), [("us", 0.4, 1.6e6), ("ms", 60.0, 3000)])
def test_times_that_may_be_dates_or_of_a_clock_are_asked_about(unit, duration, rate):
    t = in_unit(made_up(duration, rate), unit, 0, int) + 1_700_000_000_000
    with pytest.raises(
        ValueError, match="time_unit must be ms or us, got auto: times in ms are da"
    ):
        find_unit(sampled(t), "auto")
    assert find_unit(sampled(t), unit)[0] == unit
    t = made_up(0.4, 1e6) // 1000 * 1000 + 15 * 10**14  # ns of a clock that has run for 17 days
    with pytest.raises(
        ValueError, match="time_unit must be us or ns, got auto: times in us are da"
    ):
        find_unit(sampled(t), "auto")


@pytest.mark.parametrize(("unit", "kind"), [("us", int), ("ns", int), ("s", float)])
def test_dates_of_one_unit_alone_need_no_line(unit, kind):
    date = in_unit(made_up(1.0, 1e6), unit, DATE_S, kind)
    assert find_unit(sampled(date), "auto") == (unit, "")


def test_nanoseconds_are_not_taken_for_a_slow_recording():
    unit, line = find_unit(sampled(made_up(0.2, 7500)), "auto")
    assert unit == "ns" and "read as ns; if it is another, give time_unit=" in line
    unit, line = find_unit(sampled(made_up(2.0, 1e6) // 1000 * 1000), "auto")  # of a clock of us
    assert unit == "ns" and "times in ns give 2 s and 1e+06 events/s" in line
    assert "in us 2e+03 s" in line and "time_unit=" in line


@pytest.mark.parametrize(
    ("duration", "rate"),
    [
        (20.0, 300), (300.0, 1000), (60.0, 500),  # not nanoseconds of a faster recording
        (60.0, 50), (20.0, 60), (300.0, 90), (1800.0, 200), (7200.0, 500),  # a night's
    ],
)  # fmt: skip
def test_microseconds_of_a_slow_recording_are_microseconds(duration, rate):
    assert find_unit(sampled(in_unit(made_up(duration, rate), "us", 0, int)), "auto")[0] == "us"


def test_silence_does_not_change_the_unit():
    t = in_unit(made_up(0.5, 4e4), "us", 0, int)
    t[len(t) // 2 :] += 300_000_000
    assert find_unit(sampled(t, 1), "auto") == ("us", "")


@pytest.mark.parametrize("duration", [2.0, 5.0, 60.0])
def test_whole_milliseconds_are_told_of(duration):
    unit, line = find_unit(sampled(in_unit(made_up(duration, 2e4), "ms", 0, int)), "auto")
    assert unit in ("us", "ms") and f"in ms {duration:.3g} s" in line and "time_unit=" in line


@pytest.mark.parametrize(("duration", "rate"), [(100.0, 1e4), (300.0, 3333), (60.0, 5000)])
def test_whole_milliseconds_of_a_long_recording_are_told_of(duration, rate):
    """Five events and more at a time: 3 to 10 million a second, were they microseconds."""
    unit, line = find_unit(sampled(in_unit(made_up(duration, rate), "ms", 0, int)), "auto")
    assert unit == "us" and f"in ms {duration:.3g} s" in line and "time_unit=" in line


def test_fractions_finer_than_microseconds_are_told_of():
    """Milliseconds with all digits of a float cannot be told from seconds."""
    t = np.sort(np.random.default_rng(0).random(6000)) * 300
    unit, line = find_unit(sampled(t), "auto")
    assert unit == "s" and "in ms 0.3 s and 2e+04 events/s: read as s" in line


@pytest.mark.parametrize(("bits", "duration"), [(24, 40.0), (31, 0.5), (32, 0.5)])
@pytest.mark.parametrize("pieces", [1, 7])
def test_a_counter_that_goes_round_is_seen(bits, duration, pieces):
    t = in_unit(made_up(duration, 1e5), "us", 0, int) + 2**bits - 200_000
    sample = sampled(t % 2**bits, pieces)
    assert sample.wrap_bits == bits and find_unit(sample, "auto") == ("us", "")
    assert sample.early_time_and_span()[1] == pytest.approx(duration * 1e6, rel=0.01)


@pytest.mark.parametrize(("bits", "duration"), [(24, 40.0), (31, 0.5), (32, 0.5)])
@pytest.mark.parametrize("pieces", [1, 7])
def test_a_counter_whose_events_are_out_of_order_goes_round_once(bits, duration, pieces):
    t = in_unit(made_up(duration, 1e5), "us", 0, int) + 2**bits - 200_000
    t += np.random.default_rng(0).integers(-1000, 1000, len(t))
    sample, clock = sampled(t % 2**bits, pieces), TimestampUnwrapper(bits)
    found = [clock.unwrap(part) for part in np.array_split(t % 2**bits, pieces)]
    assert sample.wrap_bits == bits and np.array_equal(np.concatenate(found), t)


def test_a_long_silence_after_a_counter_went_round_is_kept():
    t = 2**32 + np.array([-5, 3, 40 * 60 * 1_000_000, 2**32 - 10, 2**32 + 4, 2**32 - 2])
    assert np.array_equal(TimestampUnwrapper().unwrap(t % 2**32), t)
    turn = 2**24
    early = turn + np.arange(50_000)
    late = early[-1] + int(0.985 * turn) + np.arange(20_000)
    t = np.concatenate([[turn - 9], early, late])
    assert np.array_equal(TimestampUnwrapper(24).unwrap(t % turn), t)


def test_a_single_wild_time_and_a_restart_are_no_counter_that_goes_round():
    t = in_unit(made_up(0.5, 1e5), "us", 0, int)
    wild = np.insert(t, len(t) // 2, 2**32 - 1)
    assert sampled(wild).wrap_bits == sampled(np.concatenate([t, t])).wrap_bits == 0


@pytest.mark.parametrize(
    ("duration", "others", "bits"),
    [(16.7, 99, 0), (16.7, 100, 24), (15.7, 5000, 0), (16.3, 5000, 0)],
)
def test_a_counter_falls_from_its_top_and_goes_on(duration, others, bits):
    t = in_unit(made_up(duration, 1e4), "us", 0, int)
    t[-1] = duration * 1e6
    assert sampled(np.concatenate([t, t[:others]])).wrap_bits == bits
    assert sampled(np.concatenate([t, np.zeros(others, int)])).wrap_bits == 0


def test_times_that_are_all_equal_are_told_of():
    assert find_unit(sampled(np.full(8000, 1.6e9 + 0.5)), "auto") == (
        "s", "all or nearly all of 8000 times are equal",
    )  # fmt: skip


def test_what_is_stated_is_obeyed_and_told_of_where_absurd():
    t = made_up(0.2, 7500)
    unit, line = find_unit(sampled(t), "us")
    assert unit == "us" and "times in us give 200 s and 7.49 events/s" in line
    assert find_unit(sampled(t), "ns") == ("ns", "")


def test_seconds_of_a_slow_recording_have_six_digits_and_milliseconds_three():
    t = in_unit(made_up(100.0, 15), "us", 0, int)
    assert find_unit(sampled(t / 1e6), "auto") == ("s", "")
    t = in_unit(made_up(2.0, 1e5), "us", 0, int)
    unit, line = find_unit(sampled(t / 1e3), "auto")
    assert unit == "ms" and "times in ms give 2 s" in line


@pytest.mark.parametrize(
    ("t", "unit"), [([50, 60], "us"), ([0.5, 0.6], "s"), ([5.0, 6.0], "us"), ([], "us")]
)
def test_too_few_times_go_by_their_kind(t, unit):
    assert find_unit(sampled(np.array(t), 1), "auto") == (unit, "")


def test_whole_numbers_never_go_through_floats():
    t = np.array([2**61 + 1, 2**61 + 3])
    assert to_us(t, "us").tolist() == t.tolist()
    ns = np.array([1_600_000_000_123_456_789, -1_500, 499])
    assert to_us(ns, "ns").tolist() == [1_600_000_000_123_457, -1, 0]
    assert to_us(np.array([1_600_000_000_123]), "ms").tolist() == [1_600_000_000_123_000]
    assert to_us(np.array([0.000450, 1.6e9 + 0.25]), "s").tolist() == [450, 1_600_000_000_250_000]


@pytest.mark.parametrize(
    ("t", "unit"), [([0, np.nan], "s"), ([np.inf], "us"), ([1e15], "s"), ([2**62], "us")]
)
def test_times_that_cannot_be_are_refused(t, unit):
    with pytest.raises(ValueError, match=r"a.txt: times must be finite and within 2\^62 us"):
        check_times(np.array(t), unit, Path("a.txt"))
    check_times(np.array([]), unit, Path("a.txt"))
