"""Times and orders of files that people report trouble with, each made anew, and the files."""

from pathlib import Path

import numpy as np
import pytest

from src.recordings.files import ReadOptions, open_recording, read_events
from src.recordings.files.event_file import EVENT
from tests.recordings.files.tables import quiet_read

SIZE = (320, 240)
Rows = list[tuple[float, int, int, int]]


def scene(n: int = 1500) -> np.ndarray:
    """Return events of 0.2 s, times all different."""
    g = np.random.default_rng(0)
    events = np.empty(n, EVENT)
    events["t"] = np.sort(g.choice(np.arange(450, 200_000), n, replace=False))
    events["x"], events["y"] = g.integers(0, SIZE[0], n), g.integers(0, SIZE[1], n)
    events["p"] = g.choice([-1, 1], n)
    return events


def text(path: Path, events: np.ndarray, form="{:.6f}", unit=1e-6, head="320 240", comma=" "):
    """Write a line for each event, its time in `unit` as `form` has it."""
    rows = ((form.format(t * unit), x, y, p) for t, x, y, p in events.tolist())
    lines = [comma.join(map(str, row)) for row in rows]
    path.write_text("\n".join([head, *lines]) + "\n")
    return path


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("form", ["{:g}", "{!r}", "{:.9f}"])
def test_seconds_whose_first_line_is_0_or_1e_06(tmp_path, first, form):
    events = scene()
    events["t"] += first - events["t"][0]
    assert np.array_equal(quiet_read(text(tmp_path / "a.txt", events, form)), events)


def test_a_whole_second_where_a_block_begins(tmp_path):
    events = np.zeros(2**18 + 5000, EVENT)
    events["t"] = np.linspace(2_000_010, 2_999_990, len(events)).astype(int)
    events["t"][2**18 :] = 3_000_000 + np.arange(5000) * 10
    events["x"], events["y"], events["p"] = np.arange(len(events)) % 320, 7, 1
    assert np.array_equal(quiet_read(text(tmp_path / "a.txt", events, "{:.9g}")), events)


@pytest.mark.parametrize("form", ["{:.1f}", "{:d}"])
def test_whole_microseconds_with_a_point_are_no_seconds(tmp_path, form):
    head = "t,x@320,y@240,p"
    path = text(tmp_path / "a.csv", scene(), form, 1, head, ",")
    assert np.array_equal(quiet_read(path), scene())


def test_whole_nanoseconds_are_told_and_can_be_stated(tmp_path):
    events = scene()
    columns = {name: events[name] for name in "xyp"}
    np.savez(tmp_path / "a.npz", t=events["t"] * 1000, **columns)
    assert np.array_equal(quiet_read(tmp_path / "a.npz", time_unit="ns"), events)
    with pytest.warns(UserWarning, match=r"times in ns give 0.2 s .*: read as ns"):
        assert np.array_equal(read_events(tmp_path / "a.npz"), events)
    with pytest.warns(UserWarning, match=r"times in us give 200 s and .* in ns .* time_unit="):
        slow = read_events(tmp_path / "a.npz", options=ReadOptions(time_unit="us"))
    assert np.array_equal(slow["t"], events["t"] * 1000)


def test_all_on_then_all_off_is_one_recording(tmp_path):
    events = scene()
    order = np.argsort(events["p"] < 0, kind="stable")
    path = text(tmp_path / "a.txt", events[order])
    with pytest.warns(UserWarning, match="one polarity come before the others, sorted by time"):
        assert np.array_equal(read_events(path), events)


def test_pixel_by_pixel_within_frames_is_sorted(tmp_path):
    events = scene()
    order = np.lexsort([events["x"], events["y"], events["t"] // 33_000])
    path = text(tmp_path / "a.txt", events[order])
    with pytest.warns(UserWarning, match=r"events up to 0.03\d* s out of order, sorted"):
        assert np.array_equal(read_events(path), events)


def test_two_recordings_in_one_file_are_told_and_chosen(tmp_path):
    parts = scene()[:1000], scene()[300:]
    path = text(tmp_path / "a.txt", np.concatenate(parts))
    with pytest.warns(
        UserWarning, match=r"clock restarts.* part=0 of 2 is read \(0: 1000 .*, 1: 1200 "
    ):
        assert np.array_equal(read_events(path), parts[0])
    for part in (0, 1):
        assert np.array_equal(quiet_read(path, part=part), parts[part])
    with pytest.raises(ValueError, match=r"part must be in 0..1, the parts of .*a.txt, got 2"):
        read_events(path, options=ReadOptions(part=2))


@pytest.mark.parametrize("wild", [3_600_000_000, -5_000_000])
def test_one_wild_time_is_dropped_and_counted(tmp_path, wild):
    whole = np.insert(scene(), 40, np.array((wild, 1, 1, 1), EVENT))
    path = text(tmp_path / "a.txt", whole)
    with pytest.warns(UserWarning, match="1 of 1501 events far out of order of time, dropped"):
        assert np.array_equal(read_events(path), scene())


def test_a_shuffled_file_is_refused_when_it_is_opened(tmp_path):
    events = scene()
    events["t"] *= 511  # 102 s
    path = text(tmp_path / "a.txt", np.random.default_rng(0).permutation(events))
    with pytest.raises(ValueError, match=r"a.txt: .* % of 1500 events are more than"):
        open_recording(path)


def test_last_events_after_a_long_silence_are_called_so(tmp_path):
    t = np.concatenate([np.arange(20_000) * 50, 12_000_000 + np.arange(199) * 100])
    np.savez(tmp_path / "a.npz", t=t, x=t % 320, y=t % 240, p=t % 2)
    words = "the last 199 of 20199 events after a silence of 11 s, dropped"
    with pytest.warns(UserWarning, match=words) as told:
        assert len(read_events(tmp_path / "a.npz")) == 20_000
    assert len(told) == 1


@pytest.mark.parametrize("scale", [1, 50])
def test_a_reversed_file_is_sorted_or_refused(tmp_path, scale):
    """Of 0.2 s it is no more out of order than one that goes by frames; of 10 s it is."""
    events = scene()
    events["t"] *= scale
    path = text(tmp_path / "a.txt", events[::-1])
    if scale == 1:
        with pytest.warns(UserWarning, match="1499 of 1500 events up to 0.199 s out of order"):
            assert np.array_equal(read_events(path), events)
        return
    with pytest.raises(ValueError, match="times go backward from event to event, it must be sort"):
        open_recording(path)


def test_all_events_off_the_sensor_are_told(tmp_path):
    events = scene()
    events["x"], events["y"] = 320, 2
    path = text(tmp_path / "a.txt", events)
    words = "all 1500 events are off the 320x240 sensor, they need 321x3"
    with pytest.raises(ValueError, match=words):
        read_events(path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"time_unit": "min"}, "time_unit must be auto, s, ms, us or ns, got min"),
        ({"part": -1}, "part must be null or a whole number from 0 on, got -1"),
        ({"part": "b"}, "part must be a whole number, got b"),
        ({"format": "evt4"}, "format must be null, evt2, evt21, evt3, got evt4"),
        ({"columns": "xyp"}, "columns must have t, x, y and p once each, got xyp"),
        ({"stream": 1.5}, "stream must be a number or a name, got 1.5"),
    ],
)
def test_a_wrong_option_is_one_line(options, words):
    with pytest.raises(ValueError, match=words):
        ReadOptions.from_keys(vars(ReadOptions()) | options)


# Files of the scene of good.txt: what has to be stated, and how much before it they begin, us.
SHARED: dict[str, tuple[dict, int]] = {
    "seconds_first_line_0.txt": ({}, 450),
    "seconds_first_line_1e-06.txt": ({}, 449),
    "two_recordings_joined.txt ": ({"part": 1}, 0),
    "mvsec.h5": ({}, -1_506_117_882_000_000),  # it has the time of day
    "dsec_blosc.h5": ({}, -57_922_807_588),  # of its t_offset
    "old_header.raw": ({"format": "evt2"}, 0),
    **{name: ({}, 0) for name in (
        "us_with_point.csv", "nanoseconds_esim.npz", "on_then_off.txt", "voltmeter_order.txt",
        "two_recordings_joined.txt", "one_wild_time.txt", "dsec_export_xypt_tabs.txt",
        "metavision.csv", "metavision_geometry.csv", "bom_excel.csv", "v2e_text.txt", "v2e.h5",
        "raw_events_group.hdf5", "structured.npy", "structured.npz",
        "gen1_type0.dat", "height_first.dat", "format_line_only.raw", "UPPER.RAW",
    )},
}  # fmt: skip


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", SHARED)
def test_reported_files_hold_the_scene(shared_data, name):
    folder, (options, before_us) = shared_data / "reported", SHARED[name]
    if not folder.is_dir():
        pytest.skip("the reported files are not here")
    good = read_events(folder / "good.txt")
    found = read_events(folder / name.strip(), options=ReadOptions(**options))
    found["t"] += before_us
    assert len(good) == 1500
    assert np.array_equal(np.sort(found), np.sort(good))


@pytest.mark.parametrize("kind", [np.uint32, np.int32])
def test_a_counter_that_goes_round_goes_on(tmp_path, kind):
    events = scene()
    start = 2**32 - 100_000 if kind is np.uint32 else 2**31 - 100_000
    t = ((events["t"] + start) & 0xFFFFFFFF).astype(np.uint32).view(kind)
    np.savez(tmp_path / "a.npz", t=t, **{key: events[key] for key in "xyp"})
    with pytest.warns(UserWarning, match="its counter of 32 bits goes round, times go on"):
        found = read_events(tmp_path / "a.npz")
    assert np.array_equal(found["t"] - found["t"][0], events["t"] - events["t"][0])
    assert len(found) == len(events)
