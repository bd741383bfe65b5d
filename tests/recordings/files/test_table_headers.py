"""Headers of texts: names of columns in other words, blank columns, and what is not clear."""

import re
import time

import numpy as np
import pytest

from src.recordings.files import ReadOptions, read_events
from tests.recordings.files.test_table_forms import assert_read, events, lines

__all__ = ["events"]  # a fixture


def rows(events, tail=lambda place: "") -> str:
    """Return lines t,y,x,p with what `tail` says of each behind it."""
    texts = lines(events, "tyxp", ",").splitlines()
    return "".join(f"{text}{tail(place)}\n" for place, text in enumerate(texts))


@pytest.mark.parametrize(
    "tail", [lambda k: ",", lambda k: ",7" * (k > 8) or ",", lambda k: ",7" * (k < 9) or ", "]
)
@pytest.mark.parametrize("quote", ["", '"'])
def test_a_blank_column_is_a_missing_value(tmp_path, events, tail, quote):
    text = "timestamp,y,x,polarity,label\n" + rows(events, tail)
    quoted = [quote + line.replace(",", f"{quote},{quote}") + quote for line in text.splitlines()]
    (tmp_path / "a.csv").write_text("\n".join(quoted))
    assert_read(tmp_path / "a.csv", events)


def test_a_blank_column_before_the_others(tmp_path, events):
    text = "".join(f",{text}\n" for text in rows(events).splitlines())
    (tmp_path / "a.csv").write_text("label,t,y,x,p\n" + text)
    assert_read(tmp_path / "a.csv", events)


def test_a_blank_time_is_no_event(tmp_path, events):
    broken = rows(events[:9], lambda k: ",7") + ",1,2,1,7\n" + rows(events[10:], lambda k: ",")
    (tmp_path / "a.csv").write_text("t,y,x,p,label\n" + broken)
    with pytest.raises(ValueError, match="line 11 is no event: ',1,2,1,7'"):
        read_events(tmp_path / "a.csv")


def test_a_stated_order_may_skip_a_blank_column(tmp_path, events):
    (tmp_path / "a.csv").write_text("t,y,x,p,label\n" + rows(events, lambda k: ","))
    assert_read(tmp_path / "a.csv", events, columns="tyxpl")


@pytest.mark.parametrize(
    "head",
    [
        "event_t,event_y,event_x,event_p", "ev_timestamp,ev_y,ev_x,ev_pol",
        "event.t,event.y,event.x,event.p", "t,ypos,xpos,p", "t,y_pos,x_pos,p",
        "t,pixel_y,pixel_x,p", "eventTime,coordY,coordX,polarity", "# each line: t y x p",
        "# each line: t, y, x, p", "# timestamp (us) y x polarity",
        "left_ts,left_row,left_col,left_on",
    ],
)  # fmt: skip
def test_a_part_of_each_name_is_enough(tmp_path, events, head):
    (tmp_path / "a.csv").write_text(f"{head}\n{rows(events)}")
    assert_read(tmp_path / "a.csv", events)


@pytest.mark.parametrize("head", ["y,x,t,p", "ev_y,ev_x,ev_t,ev_p"])
def test_a_line_of_as_many_names_goes_before_other_words(tmp_path, events, head):
    text = f"# {head}\n# made of t x y p by a script\n" + lines(events, "yxtp", ",")
    (tmp_path / "a.csv").write_text(text)
    assert_read(tmp_path / "a.csv", events)


@pytest.mark.parametrize(
    "head",
    [
        "# x right, y down, t in ms, p sign", "# sorted by t, x, y, p", "# x y p sorted by t",
        "# x in 0..345, y in 0..259, p in 0..1, t in us", "# v2e sensor size 346x260",
        "# EVK4 v3, 1280x720, 2024-01-05, indoor", "# v1.2 x64 build 77", "# y down x right",
        "# dvs-player v0.3 linux x86_64", "# ev2txt v3 --flip-x yes", "# one row per column",
    ],
)  # fmt: skip
def test_a_sentence_names_no_columns(tmp_path, events, head):
    (tmp_path / "a.txt").write_text(f"{head}\n{lines(events)}")
    assert np.array_equal(read_events(tmp_path / "a.txt"), events)


@pytest.mark.parametrize(
    "head", ["# Events: t y x p label", "# timestamp (us) y x polarity label", "t y x p label"]
)
def test_names_behind_a_title_or_with_a_unit_are_as_many_as_the_columns(tmp_path, events, head):
    text = rows(events, lambda k: ",7").replace(",", " ")
    (tmp_path / "a.txt").write_text(f"{head}\n{text}")
    assert_read(tmp_path / "a.txt", events)


@pytest.mark.parametrize("head", ["stamp,x,y,polarity,exposure_t", "when,x,y,p,start_time"])
def test_another_time_is_not_that_of_events(tmp_path, events, head):
    table = np.stack([*(events[n].astype(int) for n in "txyp"), np.full(len(events), 1000)], 1)
    np.savetxt(tmp_path / "a.csv", table, "%d", ",", header=head, comments="")
    with pytest.raises(ValueError, match="columns must say the order of the 5 columns"):
        read_events(tmp_path / "a.csv")


def test_a_header_without_events_is_soon_refused(tmp_path):
    text = ("# t x " + "a " * 97 + "\n") * 480 + "some words of prose\n" * 480
    (tmp_path / "a.txt").write_text(text)
    start = time.process_time()
    with pytest.raises(ValueError, match="no line of numbers"):
        read_events(tmp_path / "a.txt")
    assert time.process_time() - start < 10


def test_a_unit_behind_such_a_name_holds(tmp_path, events):
    slow = events.copy()
    slow["t"] *= 1500
    (tmp_path / "a.csv").write_text(f"event_time_us,event_y,event_x,event_p\n{rows(slow)}")
    assert_read(tmp_path / "a.csv", slow)


@pytest.mark.parametrize("head", ["when,yaddr,xaddr,sign", "t0,y0,x0,t1", "tick,y,x,s"])
def test_y_before_x_among_names_that_are_not_known_is_refused(tmp_path, events, head):
    (tmp_path / "a.csv").write_text(f"{head}\n{rows(events)}")
    with pytest.raises(ValueError, match=rf"a\.csv: .*columns must say which .* '{head}'"):
        read_events(tmp_path / "a.csv")
    assert_read(tmp_path / "a.csv", events, columns="tyxp")


@pytest.mark.parametrize(
    "head",
    [
        "# each row is (t, y, x, p)", "# each row contains: t,y,x,p where p in {0,1}",
        "# Format: timestamp y x polarity, 0=OFF 1=ON", "# t=timestamp, y=row, x=column, p=sign",
        "# <t> <y> <x> <p>", "# ts [us] / y [px] / x [px] / pol", "t-y-x-p", "# tyxp",
        "# of 640 x 480 pixels: t - y - x - p",
    ],
)  # fmt: skip
def test_y_before_x_in_a_sentence_is_refused(tmp_path, events, head):
    (tmp_path / "a.txt").write_text(f"{head}\n{rows(events)}")
    with pytest.raises(ValueError, match=f"columns must say which .* {re.escape(repr(head))}"):
        read_events(tmp_path / "a.txt")
    assert_read(tmp_path / "a.txt", events, columns="tyxp")
    (tmp_path / "a.txt").write_text(f"{head}\nt,y,x,p\n{rows(events)}")
    assert_read(tmp_path / "a.txt", events)


@pytest.mark.parametrize(
    "head",
    [
        "# each row is (t, x, y, p)", "# xypt",
        "# the y axis points down, the x axis right; time in us; polarity 0 or 1",
        "# Events: time, pixel (y counts from the top, x from the left), polarity",
        "# t = us, p = polarity, y down, x right", "# dataset: y=480 x=640 p=2 t=0",
        "# time 10:00; mirrored in y and x; polarity on=1",
        "# recorded by P. Y. Wang at time 12:00, version 2 x",
        "# polarity p in {0,1}, y in 0..99, x in 0..127, t in us",
    ],
)  # fmt: skip
def test_x_before_y_or_words_in_no_list_are_no_fault(tmp_path, events, head):
    (tmp_path / "a.txt").write_text(f"{head}\n{lines(events)}")
    assert_read(tmp_path / "a.txt", events)


def test_other_names_are_told_of(tmp_path, events):
    (tmp_path / "a.csv").write_text("time,line,sample,sign\n" + lines(events, between=","))
    with pytest.warns(UserWarning, match="the names in 'time,line,sample,sign' are not known"):
        read_events(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("names", "per_s"),
    [
        ("timestamp_sec,timestamp_nsec", 10**9),
        ("t_s,t_ns", 10**9),
        ("time_sec,time_usec", 10**6),
        ("ts [s],ts [microseconds]", 10**6),
    ],
)
def test_seconds_and_their_fraction_are_not_added(tmp_path, events, names, per_s):
    us = events["t"] + 1_600_000_000_000_000
    parts = [us // 10**6, us % 10**6 * (per_s // 10**6), *(events[n].astype(int) for n in "xyp")]
    np.savetxt(tmp_path / "a.csv", np.stack(parts, 1), "%d", ",", header=f"{names},x,y,p")
    table = np.rec.fromarrays(parts, names=[*names.split(","), "x", "y", "p"])
    np.save(tmp_path / "a.npy", table)
    for name in ("a.csv", "a.npy"):
        with pytest.raises(ValueError, match="times must be one column, got t"):
            read_events(tmp_path / name)
    with pytest.warns(UserWarning, match="times are equal"):
        read_events(tmp_path / "a.npy", options=ReadOptions(time_unit="s"))
    unit = "ns" if per_s == 10**9 else "us"
    chosen = ReadOptions(columns="ntxyp", time_unit=unit)
    found = read_events(tmp_path / "a.csv", options=chosen)
    assert np.array_equal(found["x"], events["x"])


def test_equal_times_of_a_named_unit_are_told_of(tmp_path, events):
    still = events.copy()
    still["t"] = 1_600_000_000
    (tmp_path / "a.csv").write_text("t_s,x,y,p\n" + lines(still, between=","))
    with pytest.warns(UserWarning, match="all or nearly all of 1500 times are equal"):
        read_events(tmp_path / "a.csv")
