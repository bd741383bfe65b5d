"""What tables state of themselves - size, unit, columns - and packed or cut ones, as found."""

import gzip
import tarfile

import h5py
import numpy as np
import pytest

from src.recordings.files import ReadOptions, read_events, text_file
from tests.recordings.files.tables import quiet_read
from tests.recordings.files.test_table_forms import assert_read, events, lines

__all__ = ["events"]  # a fixture
SLOW = 1500  # times the 0.2 s of the scene: the values alone would tell another unit


def write_columns(path, made, **attrs):
    with h5py.File(path, "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = made[name]
        file["events"].attrs.update(attrs)


def slowed(events):
    slow = events.copy()
    slow["t"] *= SLOW
    return slow


@pytest.mark.parametrize(
    ("name", "form"),
    [
        ("t_ns", lambda t: int(t) * 1000),
        ("Timestamp [us]", int),
        ("t (µs)", int),
        ("time_s", lambda t: f"{t * 1e-6:.6f}"),
    ],
)
def test_a_name_states_the_unit(tmp_path, events, name, form):
    slow = slowed(events)
    text = f"{name},x,y,p\n" + lines(slow, between=",", t=form)
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    assert np.array_equal(read_events(tmp_path / "a.csv"), slow)


@pytest.mark.parametrize(("unit", "scale"), [("ms", 1e-3), ("ns", 1e3), ("us", 1.0), ("s", 1e-6)])
def test_a_unit_in_the_name_of_the_times_holds_in_every_table(tmp_path, events, unit, scale):
    """Times of a sparse recording, finer than a microsecond, from which it cannot be told."""
    columns = {f"t_{unit}": events["t"] * 100 * scale + 1e-7} | {key: events[key] for key in "xyp"}
    kinds = [(key, column.dtype) for key, column in columns.items()]
    table = np.array(list(zip(*columns.values(), strict=True)), kinds)
    np.savez(tmp_path / "a.npz", **columns)
    np.savez(tmp_path / "b.npz", events=table)
    np.save(tmp_path / "a.npy", table)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for key, column in columns.items():
            file[f"events/{key}"] = column
    for path in ("a.npz", "b.npz", "a.npy", "a.h5"):
        assert np.array_equal(quiet_read(tmp_path / path)["t"], events["t"] * 100), path


def test_a_stated_unit_goes_before_the_name(tmp_path, events):
    (tmp_path / "a.csv").write_text("t_ns,x,y,p\n" + lines(events, between=","))
    found = read_events(tmp_path / "a.csv", options=ReadOptions(time_unit="us"))
    assert np.array_equal(found, events)
    columns = {"t_ms": events["t"] * 1e-3} | {key: events[key] for key in "xyp"}
    np.savez(tmp_path / "a.npz", **columns)
    with pytest.warns(UserWarning, match="times in s give 200 s"):
        found = read_events(tmp_path / "a.npz", options=ReadOptions(time_unit="s"))
    assert np.array_equal(found["t"], events["t"] * 1000)


@pytest.mark.parametrize(("per_us", "kind"), [(1, np.int64), (1000, np.int64), (1e-6, float)])
@pytest.mark.parametrize("slower", [1, SLOW])
def test_an_index_by_milliseconds_tells_the_unit(tmp_path, events, per_us, kind, slower):
    """DSEC's."""
    slow = events.copy()
    slow["t"] *= slower
    columns = {"t": (slow["t"] * per_us).astype(kind), **{name: slow[name] for name in "xyp"}}
    write_columns(tmp_path / "a.h5", columns)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["ms_to_idx"] = np.searchsorted(slow["t"], np.arange(0, 200 * slower) * 1000)
    assert np.array_equal(read_events(tmp_path / "a.h5"), slow)


def test_an_index_by_milliseconds_of_few_events_means_microseconds(tmp_path, events):
    few = slowed(events)[::500]
    write_columns(tmp_path / "a.h5", few)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["ms_to_idx"] = np.array([0, len(few)])
    assert np.array_equal(read_events(tmp_path / "a.h5"), few)


def test_an_offset_alone_states_no_unit(tmp_path, events):
    ns = {"t": events["t"] * 1000 + 7, **{name: events[name] for name in "xyp"}}
    write_columns(tmp_path / "a.h5", ns)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["t_offset"] = 0
    with pytest.warns(UserWarning, match="read as ns; if it is another, give time_unit="):
        assert np.array_equal(read_events(tmp_path / "a.h5")["t"], events["t"])


@pytest.mark.parametrize(
    ("attrs", "size"),
    [
        ({"geometry": np.bytes_("320x240")}, (320, 240)),
        ({"width": [320], "height": [240]}, (320, 240)),
        ({"sensor_resolution": (240, 320)}, (320, 240)),
        ({"sensor_resolution": np.bytes_("320x240")}, (320, 240)),
        ({"size": "1500 events"}, None),
    ],
)
def test_hdf5_states_its_size_in_many_ways(tmp_path, events, attrs, size):
    write_columns(tmp_path / "a.h5", events, **attrs)
    assert_read(tmp_path / "a.h5", events, size)


def test_stated_columns_go_before_names(tmp_path, events):
    (tmp_path / "a.txt").write_text("x y t p\n" + lines(events))
    assert_read(tmp_path / "a.txt", events, columns="txyp")


def test_columns_of_matlab(tmp_path, events):
    np.savez(tmp_path / "a.npz", **{name: events[name][:, None] for name in "txyp"})
    assert_read(tmp_path / "a.npz", events)


@pytest.mark.parametrize("shape", [(1, -1), (-1, 1)])
def test_columns_of_matlab_in_hdf5(tmp_path, events, shape):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            file[f"events/{name}"] = events[name].reshape(shape)
    assert_read(tmp_path / "a.h5", events)


def test_a_table_of_four_rows_in_hdf5(tmp_path, events):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = np.stack([events[name].astype(np.float64) for name in "txyp"])
    assert_read(tmp_path / "a.h5", events)


def test_another_shape_is_named(tmp_path, events):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"], file["other"] = np.zeros((100, 5)), np.zeros(3)
    with pytest.raises(ValueError, match=r"\(n, 4\) in it, but events \(100, 5\)$"):
        read_events(tmp_path / "a.h5")
    write_columns(tmp_path / "b.h5", {name: np.zeros((2, 50)) for name in "txyp"})
    with pytest.raises(ValueError, match=r"but events/p \(2, 50\), events/t \(2, 50\)"):
        read_events(tmp_path / "b.h5")


@pytest.mark.parametrize("name", ["units", "unit"])
@pytest.mark.parametrize(
    ("unit", "per_us"),
    [
        ("ns", 1000), (b"nanoseconds", 1000), ("us", 1), ("Microseconds", 1), (["us"], 1),
        ("ms", 1e-3), ("s", 1e-6), ("seconds since 1970-01-01", 1e-6), ("Time (us)", 1),
        ("time in micro seconds", 1),
    ],
)  # fmt: skip
def test_an_attribute_of_the_times_states_their_unit(tmp_path, events, name, unit, per_us):
    slow = slowed(events)
    t = slow["t"] * per_us
    write_columns(tmp_path / "a.h5", {"t": t, **{key: slow[key] for key in "xyp"}})
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["events/t"].attrs[name] = unit
    assert np.array_equal(read_events(tmp_path / "a.h5"), slow)


@pytest.mark.parametrize(
    "unit", ["", "1", "ticks", "1e-6 s", 1e-6, np.array([], "S2"), h5py.Empty("S1")]
)
def test_an_attribute_that_is_no_unit_says_nothing(tmp_path, events, unit):
    write_columns(tmp_path / "a.h5", events)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["events/t"].attrs["units"] = unit
    assert_read(tmp_path / "a.h5", events)


@pytest.mark.parametrize("beside", [(4, 100), (4, 346)])
def test_other_arrays_of_four_rows_are_no_events(tmp_path, events, beside):
    write_columns(tmp_path / "a.h5", events)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["event_rates"] = np.random.default_rng(0).random(beside)
        for name in "txyp":
            file[f"calib/{name}"] = np.ones((1, 1))
    assert_read(tmp_path / "a.h5", events)


def test_an_offset_beside_the_columns_is_added(tmp_path, events):
    write_columns(tmp_path / "a.h5", events)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["events/t_offset"] = 5_000_000_000
    assert read_events(tmp_path / "a.h5")["t"][0] == 5_000_000_000 + events["t"][0]


def test_a_cut_gz_is_read_up_to_its_last_whole_line(tmp_path, events):
    content = gzip.compress(lines(events, "xypt").encode())
    (tmp_path / "a.txt.gz").write_bytes(content[: len(content) * 7 // 10])
    with pytest.warns(UserWarning, match="gzip stream is cut, what follows is miss"):
        found = read_events(tmp_path / "a.txt.gz")
    assert 900 < len(found) < 1200
    assert np.array_equal(found, events[: len(found)])


def test_a_cut_line_may_be_the_only_one_of_the_last_block(tmp_path, events, monkeypatch):
    text = lines(events)
    monkeypatch.setattr(text_file, "CHUNK", len(text))
    (tmp_path / "a.txt").write_text(text + "200999 1")
    with pytest.warns(UserWarning, match="last line is cut"):
        assert np.array_equal(read_events(tmp_path / "a.txt"), events)


def write_joint_npz(path, made, xy):
    np.savez(path / "a.npz", t=made["t"], xy=xy, p=made["p"])
    return path / "a.npz"


def write_joint_fields(path, made, xy):
    table = np.zeros(len(made), [("t", "i8"), ("xy", "u2", xy.shape[1:]), ("p", "i1")])
    table["t"], table["xy"], table["p"] = made["t"], xy, made["p"]
    np.save(path / "a.npy", table)
    return path / "a.npy"


def write_joint_hdf5(path, made, xy):
    with h5py.File(path / "a.h5", "w") as file:
        for name, column in {"t": made["t"], "xy": xy, "p": made["p"]}.items():
            file[f"events/{name}"] = column
    return path / "a.h5"


JOINT_WRITERS = [write_joint_npz, write_joint_fields, write_joint_hdf5]


@pytest.mark.parametrize("write", JOINT_WRITERS)
def test_x_and_y_may_be_one_column(tmp_path, events, write):
    path = write(tmp_path, events, np.stack([events["x"], events["y"]], 1))
    assert np.array_equal(read_events(path), events)


@pytest.mark.parametrize("write", JOINT_WRITERS)
def test_a_joint_column_of_three_is_refused(tmp_path, events, write):
    path = write(tmp_path, events, np.stack([events["x"], events["y"], events["x"]], 1))
    with pytest.raises(ValueError, match=r"xy must be \(n, 2\)"):
        read_events(path)


@pytest.mark.parametrize("kind", ["M8[us]", "m8[us]", "m8[ns]"])
def test_dates_and_durations_have_their_unit(tmp_path, events, kind):
    slow = slowed(events)
    t = slow["t"].astype("m8[us]").astype(kind.replace("M", "m"))
    t = np.datetime64("1970-01-01") + t if kind[0] == "M" else t
    np.savez(tmp_path / "a.npz", t=t, x=slow["x"], y=slow["y"], p=slow["p"])
    assert np.array_equal(read_events(tmp_path / "a.npz"), slow)
    with pytest.raises(ValueError, match="time_unit must be auto or us"):
        read_events(tmp_path / "a.npz", options=ReadOptions(time_unit="ns"))


def test_a_missing_date_is_refused(tmp_path, events):
    t = events["t"].astype("m8[us]")
    t[5] = np.timedelta64("NaT")
    np.savez(tmp_path / "a.npz", t=t, x=events["x"], y=events["y"], p=events["p"])
    with pytest.raises(ValueError, match="times must have a unit and a value each"):
        read_events(tmp_path / "a.npz")


def test_a_packed_recording_that_is_no_text_is_to_be_unpacked(tmp_path):
    (tmp_path / "a.raw.gz").write_bytes(gzip.compress(b"% evt 3.0\n" + bytes(100)))
    with pytest.raises(ValueError, match="unpack a.raw first"):
        read_events(tmp_path / "a.raw.gz")


def test_a_tar_is_to_be_unpacked(tmp_path, events):
    """Its first line of text would be one of the archive."""
    (tmp_path / "events.txt").write_text(lines(events))
    for name in ("a.tar.gz", "a.gz"):
        with tarfile.open(tmp_path / name, "w:gz") as archive:
            archive.add(tmp_path / "events.txt", "rec/events.txt")
    with pytest.raises(ValueError, match=r"unpack a\.tar first"):
        read_events(tmp_path / "a.tar.gz")
    with pytest.raises(ValueError, match=r"it is a \.tar; unpack it first"):
        read_events(tmp_path / "a.gz")


@pytest.mark.parametrize("other", ["timestamp", "time_us", "ts"])
def test_two_columns_of_times_are_refused(tmp_path, events, other):
    """The first may be a mere count."""
    columns = {"t": np.arange(len(events)), other: events["t"], "x": events["x"]}
    columns |= {"y": events["y"], "p": (events["p"] > 0).astype(int)}
    table = np.rec.fromarrays([*columns.values()], names=[*columns])
    np.save(tmp_path / "a.npy", table)
    np.savez(tmp_path / "a.npz", **columns)
    np.savetxt(tmp_path / "a.csv", table, "%d", ",", header=",".join(columns), comments="")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, column in columns.items():
            file[f"events/{name}"] = column
    for name in ("a.npy", "a.npz", "a.csv", "a.h5"):
        with pytest.raises(ValueError, match=rf"{name}: .*one column, got t, {other}; rename one"):
            read_events(tmp_path / name)
    for name in ("a.npy", "a.csv"):
        assert_read(tmp_path / name, events, columns="ntxyp")


def test_times_of_something_else_are_no_second_column(tmp_path, events):
    columns = {name: events[name] for name in "txyp"} | {"timestamps": np.arange(3)}
    np.savez(tmp_path / "a.npz", **columns)
    write_columns(tmp_path / "a.h5", events)
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["events/timestamps"] = np.arange(3)
    for name in ("a.npz", "a.h5"):
        assert_read(tmp_path / name, events)
