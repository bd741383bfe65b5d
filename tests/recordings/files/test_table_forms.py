"""Tables of events as people have them - text, .npy, .npz, HDF5 - each read event by event."""

import gzip
import warnings
import zipfile
from pathlib import Path

import h5py
import hdf5plugin
import numpy as np
import pytest

from src.recordings.files import ReadOptions, open_recording, read_events, text_file
from src.recordings.files.event_file import EVENT
from tests.recordings.files.tables import write_events

WIDTH, HEIGHT = 320, 240


@pytest.fixture(scope="module")
def events() -> np.ndarray:
    """A bar that moves to the right: in order of time, 0.2 s, microseconds."""
    rng = np.random.default_rng(0)
    made = np.empty(1500, EVENT)
    made["t"] = np.sort(rng.choice(200_000, len(made), replace=False)) + 450
    made["x"] = 60 + made["t"] // 1000 + rng.integers(0, 4, len(made))
    made["y"] = rng.integers(60, 180, len(made))
    made["p"] = rng.integers(0, 2, len(made)) * 2 - 1
    return made


def lines(events: np.ndarray, order: str = "txyp", between: str = " ", **form) -> str:
    """Return the events as lines; `form`: of a column's value, else a whole number."""
    form = {"p": lambda p: int(p > 0)} | form
    values = [[form.get(name, int)(e[name]) for name in order] for e in events]
    return "".join(between.join(map(str, row)) + "\n" for row in values)


def seconds(t: int) -> str:
    return f"{t * 1e-6:.6f}"


TEXTS = {
    "seconds": lambda e: lines(e, t=seconds),
    "size, then seconds": lambda e: "320 240\n" + lines(e, t=seconds),
    "microseconds": lambda e: lines(e),
    "microseconds with a point": lambda e: lines(e, t=float),
    "names": lambda e: "t,x,y,p\n" + lines(e, between=","),
    "names in capitals, another order": lambda e: (
        "X,Y,Polarity,Timestamp\n" + lines(e, "xypt", ",")
    ),
    "names with units": lambda e: "timestamp_us;x [px];y [px];on\n" + lines(e, between=";"),
    "names after a comment mark": lambda e: "# y x t p\n" + lines(e, "yxtp"),
    "names with sides": lambda e: "t x@320 y@240 p\n" + lines(e),
    "x y p t without names": lambda e: lines(e, "xypt", ","),
    "x y t p without names": lambda e: lines(e, "xytp", "\t"),
    "metavision": lambda e: "%geometry:320,240\n" + lines(e, "xypt", ","),
    "byte-order mark": lambda e: "\ufefft,x,y,p\n" + lines(e, between=","),
    "lines of Windows": lambda e: lines(e, between=",").replace("\n", "\r\n"),
    "comments": lambda e: "#!v2e\n# time (float s), x, y, polarity (0=off)\n\n// 3 4\n" + lines(e),
    "comments between events": lambda e: lines(e[:700]) + "# pause\n\n" + lines(e[700:]),
    "True and False": lambda e: lines(e, p=lambda p: bool(p > 0)),
    "ON and OFF": lambda e: "t x y p\n" + lines(e, p=lambda p: "ON" if p > 0 else "OFF"),
    "-1 and 1": lambda e: lines(e, p=int),
    "decimal commas": lambda e: lines(e, between=";", t=seconds).replace(".", ","),
    "decimal commas between tabs": lambda e: lines(e, "txyp", "\t", t=seconds).replace(".", ","),
    "several separators": lambda e: (
        "# t x y p\n"
        + "".join("{}, {}\t{}  {}\n".format(*r.split()) for r in lines(e).splitlines())
    ),
    "quotes": lambda e: (
        '"t","x","y","p"\n' + lines(e, between='","').replace("\n", '"\n"').join('""')[:-2]
    ),
    "separators at the end": lambda e: "t,x,y,p,\n" + lines(e, between=",").replace("\n", ",\n"),
    "whole numbers with points": lambda e: lines(e, t=seconds, x=float, y=float, p=float),
    "more columns": lambda e: "n t x y p\n" + "".join(f"7 {s}\n" for s in lines(e).splitlines()),
    "no newline at the end": lambda e: lines(e).rstrip("\n"),
}


def assert_read(path: Path, events: np.ndarray, size: tuple[int, int] | None = None, **options):
    """Assert that the file has the events, its clock aside, without a warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_events(path, options=ReadOptions(**options))
        assert open_recording(path, options=ReadOptions(**options)).size == size
    assert len(found) == len(events)
    for name in "xyp":
        assert np.array_equal(found[name], events[name]), name
    assert np.array_equal(found["t"] - found["t"][0], events["t"] - events["t"][0])


@pytest.mark.parametrize("kind", TEXTS)
def test_text_as_people_have_it(tmp_path, events, kind):
    path = tmp_path / "a.txt"
    path.write_text(TEXTS[kind](events), encoding="utf-8")
    stated = {"size, then seconds", "names with sides", "metavision"}
    assert_read(path, events, (WIDTH, HEIGHT) if kind in stated else None)


def test_packed_text(tmp_path, events):
    with gzip.open(tmp_path / "a.csv.gz", "wt") as file:
        file.write(lines(events))
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("events.txt", lines(events))
    assert_read(tmp_path / "a.csv.gz", events)
    assert_read(tmp_path / "a.zip", events)


def test_events_of_a_zip_with_other_texts(tmp_path, events):
    """As a data set has them, packed by macOS."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        for name in ("images.txt", "shapes/events.txt", "__MACOSX/shapes/._events.txt"):
            archive.writestr(name, lines(events) if name[0] == "s" else "0.1 a.png")
    assert_read(tmp_path / "a.zip", events)


def test_a_zip_with_backslashes_in_its_names(tmp_path, events):
    """As .NET packed it."""
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as archive:
        archive.writestr("rec\\imu.txt", "0 0\n")
        archive.writestr("rec\\events.txt", lines(events))
    assert_read(tmp_path / "a.zip", events)


@pytest.mark.parametrize(
    ("comment", "size"),
    [
        ("# resolution: width=320, height=240", (WIDTH, HEIGHT)),
        ("# sensor size (width, height): 320 240", (WIDTH, HEIGHT)),
        ("# size of the file: 1234 bytes, 1500 lines", None),
        ("# file size 1024 2048", None),
        ("# chunksize 512 512", None),
        ("# pixelsize: 18 x 18 um", None),
        ("# timestamp resolution 1 1000", None),
        ("# size of file 123 456 bytes", None),
        ("# screen size 1920x1080, sensor size 320x240", (WIDTH, HEIGHT)),
        ("# image size (h,w): 240 320", (WIDTH, HEIGHT)),
        ("# sensor size (height x width) = 240 x 320", (WIDTH, HEIGHT)),
        ("# resolution = (240, 320) (rows, columns)", (WIDTH, HEIGHT)),
        ("# DAVIS346 resolution: 320 by 240 pixels", (WIDTH, HEIGHT)),
        ("# time resolution: 1e-06 s", None),
        ("# Device resolution: 320x240", (WIDTH, HEIGHT)),
        ("# simulated, resolution_px 320 240", (WIDTH, HEIGHT)),
        ("# The resolution of this sensor is 320x240", (WIDTH, HEIGHT)),
        ("# geometry 320 240 events 1500", (WIDTH, HEIGHT)),
        ("# sensor size 320 240 (one event per row, columns t x y p)", (WIDTH, HEIGHT)),
        ("# resolution 320x240 (rows y, columns x)", (WIDTH, HEIGHT)),
    ],
)
def test_only_two_sides_in_a_comment_are_a_sensor_size(tmp_path, events, comment, size):
    (tmp_path / "a.txt").write_text(f"{comment}\n{lines(events)}")
    assert_read(tmp_path / "a.txt", events, size)


def test_integers_are_exact_beyond_what_a_float_holds(tmp_path, events):
    epoch_ns = 1_700_000_000_123_456_789
    path = tmp_path / "a.txt"
    path.write_text(lines(events, t=lambda t: epoch_ns + 1000 * int(t)))
    found = read_events(path, options=ReadOptions(time_unit="ns"))
    assert np.array_equal(found["t"], (epoch_ns + 1000 * events["t"] + 500) // 1000)


def test_times_may_turn_from_whole_numbers_to_fractions(tmp_path, events, monkeypatch):
    """The first block, read as integers, is no other unit than the next."""
    late = np.repeat(events, 40)
    late["t"] = np.arange(len(late)) * 10
    whole = "0 1 1 0\n" * 500
    monkeypatch.setattr(text_file, "CHUNK", len(whole))
    text = lines(late, t=lambda t: f"{t * 1e-6:g}" if t >= 10_000 else f"{t * 1e-6:.9g}")
    (tmp_path / "a.txt").write_text(whole + text)
    found = read_events(tmp_path / "a.txt", options=ReadOptions(columns="txyp"))
    assert abs(int(found["t"][-1]) - int(late["t"][-1])) <= 10


def test_a_cut_last_line_is_left_out_with_a_warning(tmp_path, events):
    (tmp_path / "a.txt").write_text(lines(events, t=seconds)[:-6])
    with pytest.warns(UserWarning, match="last line is cut"):
        found = read_events(tmp_path / "a.txt")
    assert np.array_equal(found["x"], events["x"][:-1])


@pytest.mark.parametrize("ending", ["txt", "npz"])
@pytest.mark.parametrize("dtype", [np.int8, np.int64, np.float64])
def test_polarity_of_three_values_is_refused(tmp_path, events, ending, dtype):
    p = events["p"].astype(dtype)
    p[::3] = 0
    columns = {name: events[name] for name in "txy"} | {"p": p}
    if ending == "npz":
        np.savez(tmp_path / "a.npz", **columns)
    else:
        np.savetxt(tmp_path / "a.txt", np.stack([*columns.values()], 1), "%d", header="t x y p")
    with pytest.raises(ValueError, match="polarity must be 0 and 1 or -1 and 1, got -1 and 0"):
        read_events(tmp_path / f"a.{ending}")


BAD_TEXTS = {
    "a broken line": ("1 2 3 1\n2 3 4 0\n3 b 4 1\n4 4 4 1\n", "line 3 is no event: '3 b 4 1'"),
    "a short line": ("1 2 3 1\n2 3 4\n3 4 4 1\n", "line 2 is no event"),
    "polarity 2": ("t x y p\n1 2 3 2\n2 3 4 1\n", "polarity must be -1, 0 or 1"),
    "a place below 0": ("t x y p\n1 -2 3 1\n2 3 4 1\n", r"x must be in 0..65535, got -2"),
    "half a place": ("t x y p\n1 2.5 3 1\n2 3 4 1\n", "x must be whole numbers, got 2.5"),
    "rectified places": (
        "0.1 2.5 3.2 1\n0.2 2.7 4.5 0\n",
        "only 1 of 4 columns can be one of these",
    ),
    "order unknown": ("0 1 1 0\n1 1 1 0\n0 1 1 1\n", "columns must say the order"),
    "no numbers": ("a b c d\n" * 1200, "no line of numbers"),
}


@pytest.mark.parametrize("kind", BAD_TEXTS)
def test_text_that_cannot_be_read_is_named(tmp_path, kind):
    text, message = BAD_TEXTS[kind]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(ValueError, match=message) as error:
        read_events(tmp_path / "a.txt")
    assert str(tmp_path / "a.txt") in str(error.value)


def test_text_in_utf_16_is_refused(tmp_path, events):
    (tmp_path / "a.csv").write_text(lines(events, between=","), encoding="utf-16")
    with pytest.raises(ValueError, match="save it as UTF-8"):
        read_events(tmp_path / "a.csv")


def test_the_order_of_columns_can_be_stated(tmp_path, events):
    """Of a recording at the left border x could be polarity."""
    edge = events.copy()
    edge["x"] %= 2
    (tmp_path / "a.txt").write_text(lines(edge))
    with pytest.raises(ValueError, match="columns must say the order"):
        read_events(tmp_path / "a.txt")
    assert_read(tmp_path / "a.txt", edge, columns="txyp")


def structured(events: np.ndarray) -> np.ndarray:
    made = np.empty(len(events), [("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])
    for name in "txyp":
        made[name] = events[name]
    return made


def table(events: np.ndarray, order: str, dtype=np.float64) -> np.ndarray:
    return np.stack([events[name].astype(dtype) for name in order], 1)


def test_numpy_files(tmp_path, events):
    np.save(tmp_path / "structured.npy", structured(events))
    np.save(tmp_path / "table.npy", table(events, "xytp"))
    np.savez(tmp_path / "structured.npz", events=structured(events), width=WIDTH, height=HEIGHT)
    np.savez(tmp_path / "table.npz", table(events, "txyp", np.int64))
    np.savez(tmp_path / "columns.npz", **{n: events[n] for n in "txyp"}, size=(WIDTH, HEIGHT))
    for name in ("structured.npy", "table.npy", "table.npz"):
        assert_read(tmp_path / name, events)
    for name in ("structured.npz", "columns.npz"):
        assert_read(tmp_path / name, events, (WIDTH, HEIGHT))


def test_a_structured_array_of_several_pieces_out_of_order_is_sorted(tmp_path, monkeypatch, events):
    monkeypatch.setattr("src.recordings.files.lazy_columns.PIECE_EVENTS", 400)
    late = events.copy()
    late["t"][::50] -= 700
    np.save(tmp_path / "a.npy", late)
    found = read_events(tmp_path / "a.npy")
    assert np.array_equal(found, late[np.argsort(late["t"], kind="stable")])


@pytest.mark.parametrize(
    "packing",
    [
        hdf5plugin.Blosc("zstd"), hdf5plugin.LZ4(), hdf5plugin.Zstd(), hdf5plugin.Bitshuffle(),
        {"compression": "gzip"}, {},
    ],
)  # fmt: skip
def test_hdf5_packed_by_any_codec(tmp_path, events, packing):
    """DSEC's layout; its times begin at an offset."""
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in "txyp":
            column = (events[name] > 0) if name == "p" else events[name]
            file.create_dataset(f"events/{name}", data=column, chunks=(500,), **packing)
        file["t_offset"] = 5_000_000_000
    assert_read(tmp_path / "a.h5", events)
    assert read_events(tmp_path / "a.h5")["t"][0] == 5_000_000_000 + events["t"][0]


def fill_v2e(file, events):
    made = table(events, "txyp")
    made[:, 3] = made[:, 3] > 0
    file["events"] = made.astype(np.uint32)


def fill_mvsec(file, events):
    made = table(events, "xytp")
    made[:, 2] = 1_506_117_912.0 + made[:, 2] * 1e-6
    file["davis/left/events"] = made
    file["davis/left/imu"] = np.zeros((9, 6))


def fill_any_group(file, events):
    for name in "txyp":
        file[f"raw_events/{name}s"] = events[name]
    file["raw_events"].attrs["width"], file["raw_events"].attrs["height"] = WIDTH, HEIGHT


def fill_structured(file, events):
    file["CD/events"] = structured(events)
    file.attrs["geometry"] = "320x240"


def fill_words(file, events):
    file["CD/events"] = structured(events)
    file.attrs["sensor_resolution"] = "320x240"


@pytest.mark.parametrize(
    "fill", [fill_words, fill_v2e, fill_mvsec, fill_any_group, fill_structured]
)
def test_hdf5_layouts(tmp_path, events, fill):
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        fill(file, events)
    stated = None if fill in (fill_v2e, fill_mvsec) else (WIDTH, HEIGHT)
    found = read_events(tmp_path / "a.hdf5")
    assert np.abs(found["t"] - found["t"][0] - events["t"] + events["t"][0]).max() <= 1
    assert all(np.array_equal(found[name], events[name]) for name in "xyp")
    assert open_recording(tmp_path / "a.hdf5").size == stated


def test_one_of_two_cameras_is_read_and_the_other_is_told_of(tmp_path, events):
    other = events[:100].copy()
    other["y"] += 1
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for camera, made in (("left", events), ("right", other)):
            for name in "txyp":
                file[f"{camera}/events/{name}"] = made[name]
    with pytest.warns(UserWarning, match=r"holds 2 event streams, 0 \(left/events\), 1 \(right"):
        assert len(read_events(tmp_path / "a.h5")) == len(events)
    for stream in ("right/events", 1):
        with pytest.warns(UserWarning, match="read is 1"):
            found = read_events(tmp_path / "a.h5", options=ReadOptions(stream=stream))
        assert np.array_equal(found["y"], other["y"])
    with pytest.raises(ValueError, match="stream must be one of"):
        read_events(tmp_path / "a.h5", options=ReadOptions(stream="up"))


def test_an_npz_states_its_size_in_two_numbers_or_not_at_all(tmp_path, events):
    columns = {name: events[name] for name in "txyp"}
    np.savez(tmp_path / "other.npz", **columns, resolution=(WIDTH, HEIGHT))
    assert open_recording(tmp_path / "other.npz", (HEIGHT, WIDTH)).size == (WIDTH, HEIGHT)
    np.savez(tmp_path / "three.npz", **columns, size=(WIDTH, HEIGHT, 3))
    with pytest.raises(ValueError, match=r"size must be \(width, height\), got"):
        open_recording(tmp_path / "three.npz")


def test_one_of_two_cameras_in_an_npz(tmp_path, events):
    right = events[:100]
    np.savez(tmp_path / "a.npz", left=table(events, "txyp"), right=table(right, "txyp"))
    with pytest.warns(UserWarning, match=r"holds 2 event streams, 0 \(left\), 1 \(right\)"):
        assert len(read_events(tmp_path / "a.npz")) == len(events)
    with pytest.warns(UserWarning, match="read is 1"):
        found = read_events(tmp_path / "a.npz", options=ReadOptions(stream="right"))
    assert np.array_equal(found["x"], right["x"])


def test_a_stream_of_a_file_of_one_camera_is_refused(tmp_path, events):
    (tmp_path / "a.txt").write_text(lines(events))
    np.savez(tmp_path / "a.npz", **{name: events[name] for name in "txyp"})
    for name in ("a.txt", "a.npz"):
        with pytest.raises(ValueError, match="stream must be null, as .* has one camera, got left"):
            read_events(tmp_path / name, options=ReadOptions(stream="left"))
    assert len(read_events(tmp_path / "a.txt", options=ReadOptions(stream=0))) == len(events)


def test_a_format_of_a_file_that_is_not_raw_is_refused(tmp_path, events):
    (tmp_path / "a.txt").write_text(lines(events))
    with pytest.raises(ValueError, match="format must be null, as .* is no RAW file, got evt3"):
        read_events(tmp_path / "a.txt", options=ReadOptions(format="evt3"))


@pytest.mark.parametrize("order", ["txypa", "atxyp"])
def test_an_order_of_more_columns_than_there_are_is_refused(tmp_path, events, order):
    (tmp_path / "a.txt").write_text(lines(events))
    with pytest.raises(ValueError, match=f"columns must name columns of a table of 4, got {order}"):
        read_events(tmp_path / "a.txt", options=ReadOptions(columns=order))


@pytest.mark.parametrize("ending", [".raw", ".dat", ".aedat4", ".es", ".npz", ".h5"])
def test_an_order_of_columns_that_have_none_is_refused(tmp_path, events, ending):
    write_events(path := tmp_path / f"a{ending}", events, width=WIDTH, height=HEIGHT)
    with pytest.raises(ValueError, match="columns must be null, as .*, got ptxy"):
        read_events(path, options=ReadOptions(columns="ptxy"))


@pytest.mark.parametrize("is_csv", [False, True])
def test_a_stated_order_comes_before_the_names_of_a_table(tmp_path, events, is_csv):
    path, names = tmp_path / ("a.csv" if is_csv else "a.npy"), ["t_s", "y", "x", "p"]
    if is_csv:
        path.write_text(",".join(names) + "\n" + lines(events).replace(" ", ","))
    else:
        table = np.empty(len(events), [(name, np.int64) for name in names])
        for name, column in zip(names, "txyp", strict=True):
            table[name] = events[column]
        np.save(path, table)
    options = ReadOptions(columns="txyp", time_unit="us")
    assert np.array_equal(read_events(path, options=options), events)


def test_a_folder_is_named_as_one(tmp_path):
    with pytest.raises(ValueError, match="must be an event file, got .*: a folder"):
        read_events(tmp_path)
