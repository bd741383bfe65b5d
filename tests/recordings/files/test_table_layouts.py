"""Tables as people have them: what their names, headers, shapes and parts mean."""

import os

import h5py
import numpy as np
import pytest

from src.recordings.files import ReadOptions, read_events
from src.recordings.files.recording import open_recording
from src.recordings.files.recording_inputs import find_sensor_size
from src.recordings.files.table_writers import write_csv, write_npz
from tests.recordings.files.tables import quiet_read
from tests.recordings.files.test_table_forms import events, lines

__all__ = ["events"]  # a fixture


@pytest.fixture
def night(events):
    """An hour with few events: the values alone would tell nanoseconds."""
    slow = events.copy()
    slow["t"] = np.linspace(0, 3_600_000_000, len(slow)).astype(np.int64)
    return slow


@pytest.mark.parametrize(("name", "write"), [("a.csv", write_csv), ("a.npz", write_npz)])
def test_what_was_written_here_is_read_back_at_any_rate(tmp_path, night, name, write):
    write(tmp_path / name, iter([night]), (640, 480))
    assert np.array_equal(quiet_read(tmp_path / name), night)


def test_an_npz_with_an_unknown_unit_is_refused(tmp_path, events):
    np.savez(tmp_path / "a.npz", time_unit="min", **{n: events[n] for n in "txyp"})
    with pytest.raises(ValueError, match="time_unit in it must be s, ms, us, ns, got min"):
        read_events(tmp_path / "a.npz")


def test_the_unit_that_an_npz_states_is_not_contradicted(tmp_path, events):
    np.savez(tmp_path / "a.npz", time_unit="us", **{n: events[n] for n in "txyp"})
    assert np.array_equal(quiet_read(tmp_path / "a.npz", time_unit="us"), events)
    for path in (tmp_path / "a.npz", tmp_path):
        with pytest.raises(ValueError, match="time_unit must be auto or us, the unit of .*got ms"):
            read_events(path, options=ReadOptions(time_unit="ms"))


def test_a_unit_in_a_name_holds_for_a_folder_of_npz(tmp_path, events):
    for number, part in enumerate(np.array_split(events, 3)):
        columns = {name: part[name] for name in "xyp"}
        np.savez(tmp_path / f"{number}.npz", t_ns=part["t"] * 1000, **columns)
    assert np.array_equal(quiet_read(tmp_path), events)


@pytest.mark.parametrize(
    "head",
    [
        "timestamp,y_coord,x_coord,polarity", "# columns: t y x p", "# (t, y, x, p)",
        "# format = [t | y | x | p]", "time,v,u,polarity", "t,y-coordinate,x-coordinate,pol",
    ],
)  # fmt: skip
def test_headers_in_other_words_name_the_columns(tmp_path, events, head):
    rows = np.stack([events[name] for name in "tyxp"], 1).tolist()
    text = "".join(f"{t},{y},{x},{int(p > 0)}\n" for t, y, x, p in rows)
    (tmp_path / "a.csv").write_text(f"{head}\n{text}")
    assert np.array_equal(quiet_read(tmp_path / "a.csv"), events)


def test_names_that_are_not_known_are_told_of(tmp_path, events):
    (tmp_path / "a.csv").write_text("t,across,down,p\n" + lines(events, between=","))
    with pytest.warns(UserWarning, match=r"names in 't,across,down,p' are not known.*columns="):
        assert np.array_equal(read_events(tmp_path / "a.csv"), events)
    assert np.array_equal(quiet_read(tmp_path / "a.csv", columns="txyp"), events)


def test_the_size_of_a_pixel_is_not_that_of_the_sensor(tmp_path, events):
    head = (
        "# sensor resolution: 640x480\n# pixel size: 15 x 15 um\n# buffer size = 4096, 32\n# 2 30\n"
    )
    (tmp_path / "a.txt").write_text(head + lines(events))
    assert open_recording(tmp_path / "a.txt").size == (640, 480)


def test_a_listing_that_is_not_of_pictures_does_not_hide_the_missing_size(tmp_path, events):
    (tmp_path / "events.txt").write_text(lines(events))
    (tmp_path / "images.txt").write_text("0.01 images/frame_0.png\n")
    with pytest.raises(ValueError, match=r"give sensor_size=\[height,width\]"):
        find_sensor_size(tmp_path / "events.txt")


def test_a_table_of_four_rows_has_events_in_its_columns(tmp_path, events):
    rows = np.stack([events[name].astype(np.int64) for name in "txyp"])
    np.save(tmp_path / "a.npy", rows)
    np.savez(tmp_path / "a.npz", events=rows)
    for name in ("a.npy", "a.npz"):
        assert np.array_equal(quiet_read(tmp_path / name), events)
    np.save(tmp_path / "b.npy", events.reshape(-1, 1))
    assert np.array_equal(quiet_read(tmp_path / "b.npy"), events)


def test_polarity_that_is_missing_is_what_the_error_names(tmp_path, events):
    rows = np.stack([*(events[name] for name in "txy"), (events["p"] > 0) + 1], 1)
    np.savetxt(tmp_path / "a.csv", rows, "%d", ",")
    with pytest.raises(ValueError, match="polarity must be -1, 0 or 1: none of the 4 columns"):
        read_events(tmp_path / "a.csv")


def test_a_pipe_is_named_as_what_it_is(tmp_path):
    os.mkfifo(tmp_path / "a.csv")
    with pytest.raises(ValueError, match="can be read only once; save it as a file"):
        read_events(tmp_path / "a.csv")


def test_few_dates_tell_their_unit(tmp_path, events):
    few = events[:80].copy()
    few["t"] += 1_700_000_000_000_000
    np.savez(tmp_path / "a.npz", t=few["t"] * 1000, **{name: few[name] for name in "xyp"})
    assert np.array_equal(quiet_read(tmp_path / "a.npz"), few)


def write_evreal(folder, events):
    np.save(folder / "events_ts.npy", events["t"] * 1e-6)
    np.save(folder / "events_xy.npy", np.stack([events["x"], events["y"]], 1))
    np.save(folder / "events_p.npy", events["p"] > 0)


def write_npz_window(folder, events, name="0.npz"):
    (folder / "events").mkdir(exist_ok=True)
    columns = {key: events[key] for key in "txyp"}
    np.savez(folder / "events" / name, **columns, time_unit="us")


@pytest.mark.parametrize("write", [write_evreal, write_npz_window])
def test_a_folder_that_is_written_anew_is_read_anew(tmp_path, events, write):
    """Longer, as long but with other times, and much shorter."""
    later = events.copy()
    later["t"] += 1_000_000
    for part in (events[:500], events, later, events[:10]):
        write(tmp_path, part)
        assert np.array_equal(quiet_read(tmp_path), part)


def test_a_folder_that_grows_is_read_to_its_end(tmp_path, events):
    for number, part in enumerate(np.array_split(events, 3)):
        write_npz_window(tmp_path, part, f"{number}.npz")
        assert len(quiet_read(tmp_path)) >= (number + 1) * (len(events) // 3)


def write_windows(path, names, parts, sizes=()):
    with h5py.File(path, "w") as file:
        for number, (name, part) in enumerate(zip(names, parts, strict=True)):
            for column in "txyp":
                file[f"{name}/{column}"] = part[column]
            if sizes:
                file[name].attrs["size"] = sizes[number]


def read_as_one(path, count: int, **options) -> np.ndarray:
    """Return the events of `count` windows; a warning other than that they are is an error."""
    with pytest.warns(UserWarning) as told:
        found = read_events(path, options=ReadOptions(**options))
    line = f"{path}: {count} event streams, one after the other, are read as one (stream= chooses"
    assert len(told) == 1 and str(told[0].message).startswith(line)
    return found


def test_numbered_windows_are_one_recording(tmp_path, events):
    parts = np.array_split(events, 12)
    parts.insert(5, events[:0])
    write_windows(tmp_path / "a.h5", [f"events/{n}" for n in range(13)], parts)
    assert np.array_equal(read_as_one(tmp_path / "a.h5", 13), events)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        for number, part in enumerate(np.array_split(events, 3)):
            file[f"event_{number:06d}"] = np.stack([part[n].astype(np.int64) for n in "txyp"], 1)
    assert np.array_equal(read_as_one(tmp_path / "b.h5", 3), events)


def test_windows_of_tables_have_the_columns_that_are_stated(tmp_path, events):
    early = events.copy()
    early["t"] //= 10  # as small as a coordinate
    early["x"] = np.arange(len(early))  # in order as time is
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number, part in enumerate(np.array_split(early, 3)):
            ones = np.stack([np.ones(len(part), int), *(part[n].astype(int) for n in "xyt")], 1)
            file[f"event_{number}"] = ones
    with pytest.raises(ValueError, match="columns must say the order"):
        read_events(tmp_path / "a.h5")
    found = read_as_one(tmp_path / "a.h5", 3, columns="pxyt", time_unit="us")
    assert np.array_equal(found["t"], early["t"]) and np.array_equal(found["x"], early["x"])


@pytest.mark.parametrize("few", [[], [[9, 1, 0, 1]], [[9, 5, 4, 1], [9, 8, 3, -1]]])
def test_all_windows_tell_the_order_of_columns(tmp_path, events, few):
    """Of one event each column can be time; of events at one moment x can, where it ascends."""
    rows = np.stack([events[name].astype(int) for name in "txyp"], 1)
    first = np.array(few, int).reshape(-1, 4)
    parts = [first, *np.array_split(rows, 3), first + np.array([400_000, 0, 0, 0])]
    (tmp_path / "events").mkdir()
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for number, part in enumerate(parts):
            file[f"events/{number}"] = part
            np.savez(tmp_path / "events" / f"{number}.npz", part)
    wanted = np.concatenate(parts)
    in_folder = quiet_read(tmp_path, time_unit="us")
    for found in (in_folder, read_as_one(tmp_path / "a.h5", len(parts), time_unit="us")):
        assert all(np.array_equal(found[name], wanted[:, k]) for k, name in enumerate("txy"))


def test_a_window_with_names_among_those_without_is_read_by_them(tmp_path, events):
    rows = np.stack([events[name].astype(int) for name in "txyp"], 1)
    (tmp_path / "events").mkdir()
    many = [rows + np.array([400_000 * k, 0, 0, 0]) for k in range(5)]
    for number, part in enumerate(many):
        np.savez(tmp_path / "events" / f"{number}.npz", part)
    last = dict(zip("pyxt", (rows + np.array([2_000_000, 0, 0, 0])).T[::-1], strict=True))
    np.savez(tmp_path / "events" / "5.npz", **last)
    found = quiet_read(tmp_path, time_unit="us")
    assert np.array_equal(found["t"], np.concatenate([*(m[:, 0] for m in many), last["t"]]))


def test_hidden_files_are_no_windows(tmp_path, events):
    write_npz_window(tmp_path, events)
    for name in ("._0.npz", ".partial.npz"):
        (tmp_path / "events" / name).write_bytes(b"PK")
    (tmp_path / "events" / "round").symlink_to("round")
    assert np.array_equal(quiet_read(tmp_path), events)


def test_cameras_with_numbers_are_several_recordings(tmp_path, events):
    write_windows(tmp_path / "a.h5", ["camera0", "camera1"], [events, events[::2]])
    with pytest.warns(UserWarning, match="camera1"):
        assert np.array_equal(read_events(tmp_path / "a.h5"), events)


@pytest.mark.parametrize(
    ("name", "sizes"),
    [
        ("cam", ()),
        ("Camera_", ()),
        ("rig/view", ()),
        ("views/", ()),
        ("leftcam", ()),
        ("events", ((320, 240), (640, 480))),
    ],
)
@pytest.mark.parametrize("first", [0, 1500])
def test_cameras_one_after_the_other_are_several_recordings(tmp_path, events, name, sizes, first):
    later = events.copy()
    later["t"] += 1_000_000
    parts = [events[:first], later]
    write_windows(tmp_path / "a.h5", [f"{name}0", f"{name}1"], parts, sizes)
    with pytest.warns(UserWarning, match=f"holds 2 event streams, 0 .*{name}0.*; read is 0"):
        assert np.array_equal(read_events(tmp_path / "a.h5"), parts[0])


def test_an_offset_beside_seconds_leaves_them_seconds(tmp_path, events):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events/t"], file["t_offset"] = events["t"] / 1e6, 0.5
        for name in "xyp":
            file[f"events/{name}"] = events[name]
    found = quiet_read(tmp_path / "a.h5")
    assert np.array_equal(found["t"], events["t"] + 500_000)
    assert np.array_equal(quiet_read(tmp_path / "a.h5", time_unit="s"), found)


def test_large_chunks_are_unpacked_once(tmp_path, events, monkeypatch):
    many = np.tile(events, 1400)  # eight pieces
    many["t"] = np.arange(len(many))
    opened = []
    original = h5py.File.__init__
    monkeypatch.setattr(
        h5py.File, "__init__",
        lambda self, *given, **options: opened.append(options) or original(self, *given, **options),
    )  # fmt: skip
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            chunks = many[name].shape
            file.create_dataset(f"events/{name}", data=many[name], chunks=chunks, compression=1)
    assert np.array_equal(quiet_read(tmp_path / "a.h5", time_unit="us"), many)
    assert max(options.get("rdcc_nbytes", 0) for options in opened) >= many["t"].nbytes
