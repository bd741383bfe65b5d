"""Writers: what other tools read, event by event, in pieces and whole or not at all."""

import json

import h5py
import numpy as np
import pytest

from src.recordings.files import event_writers
from src.recordings.files.event_file import EVENT, ReadOptions
from src.recordings.files.prophesee_file import PropheseeFile
from tests.recordings.files.test_recording import made_up

SIZE = {"width": 640, "height": 480}


def in_pieces(events: np.ndarray):
    """Yield pieces of all lengths, empty ones too."""
    yield from np.split(events, [0, 1, 1, 7, len(events) // 2])


def test_hdf5_has_the_layout_of_dsec(tmp_path):
    events = made_up(3000)
    events["t"][1500:] += 20_000
    count, seconds = event_writers.write_pieces(tmp_path / "a.h5", in_pieces(events), **SIZE)
    span = int(events["t"][-1] - events["t"][0])
    assert (count, seconds) == (3000, pytest.approx(span * 1e-6))
    with h5py.File(tmp_path / "a.h5") as file:
        t, marks = file["events/t"][:], file["ms_to_idx"][:]
        kinds = {name: file[f"events/{name}"].dtype.str for name in "txyp"}
        assert kinds == {"t": "<u4", "x": "<u2", "y": "<u2", "p": "|u1"}
        assert np.array_equal(t.astype(np.int64) + file["t_offset"][()], events["t"])
        assert np.array_equal(file["events/x"], events["x"])
        assert np.array_equal(file["events/y"], events["y"])
        assert np.array_equal(file["events/p"], events["p"] > 0)
        assert file.attrs["sensor_resolution"].tolist() == [480, 640]
    assert len(marks) == span // 1000 + 2 and marks[-1] == 3000
    for ms, index in enumerate(marks[:-1].tolist()):
        assert t[index] >= ms * 1000 and (index == 0 or t[index - 1] < ms * 1000)


def test_npz_and_csv(tmp_path):
    events = made_up(3000)
    for name in ("a.npz", "a.csv"):
        assert event_writers.write_pieces(tmp_path / name, in_pieces(events), **SIZE)[0] == 3000
    with np.load(tmp_path / "a.npz") as file:
        assert all(np.array_equal(file[name], events[name]) for name in "txy")
        assert np.array_equal(file["p"], events["p"] > 0) and file["size"].tolist() == [640, 480]
    table = np.loadtxt(tmp_path / "a.csv", np.int64, delimiter=",", skiprows=1)
    assert (tmp_path / "a.csv").read_text().startswith("t_us,x@640,y@480,p\n")
    assert all(np.array_equal(table[:, i], events[name]) for i, name in enumerate("txy"))
    assert np.array_equal(table[:, 3], events["p"] > 0)


def test_a_folder_as_evreal_reads_it(tmp_path):
    events, path = made_up(3000), tmp_path / "scene"
    for part in (events[:20], events):  # the second replaces the first
        event_writers.write_pieces(path, in_pieces(part), **SIZE, layout="evreal")
    t, xy, p = (np.load(path / f"events_{name}.npy", mmap_mode="r") for name in ("ts", "xy", "p"))
    assert np.array_equal(np.rint(t * 1e6), events["t"] - events["t"][0]) and t.dtype == np.float64
    assert np.array_equal(xy, np.stack([events["x"], events["y"]], 1))
    assert np.array_equal(p, events["p"] > 0)
    assert json.loads((path / "metadata.json").read_text()) == {"sensor_resolution": [480, 640]}
    assert [file.name for file in tmp_path.iterdir()] == ["scene"]
    (path / "notes.txt").write_text("mine")
    with pytest.raises(ValueError, match="must hold no other files than EVREAL's, got notes.txt"):
        event_writers.write_pieces(path, in_pieces(events), **SIZE, layout="evreal")
    assert (path / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(("name", "kind"), [("a.raw", "evt3"), ("a.raw", "evt2"), ("a.dat", "")])
def test_prophesees_formats_hold_a_second_piece_as_the_first(tmp_path, name, kind):
    events = made_up(3000)
    how = {"version": kind} if kind else {}
    event_writers.write_events(tmp_path / f"whole_{name}", events, **SIZE, **how)
    event_writers.write_pieces(tmp_path / name, in_pieces(events), **SIZE, **how)
    text = f"t0 {events['t'][0]}\n".encode()
    content = (tmp_path / name).read_bytes()
    assert text in content[:200].lower()
    assert len(content) <= (tmp_path / f"whole_{name}").stat().st_size + 40


@pytest.mark.parametrize("ending", [".raw", ".dat", ".aedat4", ".es", ".csv", ".npz", ".h5", ""])
def test_what_fails_leaves_what_was_there(tmp_path, ending):
    def breaks():
        yield made_up(300)
        raise ValueError("the input is broken")

    path, how = tmp_path / f"a{ending}", {} if ending else {"layout": "evreal"}
    event_writers.write_pieces(path, [made_up(9)], **SIZE, **how)
    before = sorted((p.name, p.is_dir() or p.read_bytes()) for p in tmp_path.rglob("*"))
    backwards = [made_up(9), made_up(9)]
    for pieces, words in ((breaks(), "input is broken"), (backwards, "not decrease")):
        with pytest.raises(ValueError, match=words):
            event_writers.write_pieces(path, pieces, **SIZE, **how)
    assert sorted((p.name, p.is_dir() or p.read_bytes()) for p in tmp_path.rglob("*")) == before


@pytest.mark.parametrize("ending", [".h5", ".csv", ".npz", ".raw", ".dat", ".aedat4", ".es"])
@pytest.mark.parametrize(
    ("kind", "first", "words"),
    [
        ([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("p", "i1")], (5, -3, 0, 1), "x in -3..2"),
        ([("t", "<f8"), ("x", "<i2"), ("y", "<i2"), ("p", "i1")], (0.5, 0, 0, 1), "got t float64"),
        ([("t", "<i8"), ("x", "<f4"), ("y", "<i2"), ("p", "i1")], (5, 0.5, 0, 1), "x float32"),
    ],
)
def test_events_off_the_sensor_or_in_fractions_are_refused(tmp_path, ending, kind, first, words):
    events = np.array([first, (9, 2, 1, 1)], kind)
    with pytest.raises(ValueError, match=words):
        event_writers.write_events(tmp_path / f"a{ending}", events, **SIZE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "how", "words"),
    [
        ("a.mp4", {}, r"path must end in one of .raw, .*, .hdf5, got .*a.mp4"),
        ("a", {}, "path must end in one of .raw, .*, .hdf5, got .*a$"),
        ("a.raw", {"version": "evt4"}, "version must be null, evt2 or evt3, got evt4"),
        ("a.csv", {"version": "evt2"}, "version must be null, as .*a.csv is no RAW file, got evt2"),
        ("a.h5", {"layout": "dsec"}, "layout must be null or evreal, got dsec"),
        ("a.raw", {"width": 2049}, "sides up to 2048, got 2049x480"),
        ("a.csv", {"width": 8193}, "sides up to 8192, got 8193x480"),
        ("taken", {"layout": "evreal"}, "is a folder already"),
        ("file.h5", {"layout": "evreal"}, "writes a folder, this is a file already"),
    ],
)
def test_what_cannot_be_written_is_named_before(tmp_path, name, how, words):
    (tmp_path / "taken").mkdir()
    (tmp_path / "file.h5").write_bytes(b"kept")
    with pytest.raises(ValueError, match=words):
        event_writers.write_pieces(tmp_path / name, [made_up(9)], **{**SIZE, **how})
    assert sorted(file.name for file in tmp_path.iterdir()) == ["file.h5", "taken"]
    assert (tmp_path / "file.h5").read_bytes() == b"kept"


@pytest.mark.parametrize(
    ("name", "times", "words"),
    [
        ("a.raw", [0, 2**23], "EVT3 cannot hold a silence of 8388608 us, use version=evt2"),
        ("a.es", [0, 2**32], ".es cannot hold a time of 4294967296 us, use .npz"),
        ("a.dat", [0, 2**32], "cannot hold 4294967296 us, use .npz"),
        ("a.h5", [5, 2**32 + 5], "cannot hold 4294967296 us, use .npz"),
        ("a.npz", [-1, 0], "times must start at 0"),
    ],
)
@pytest.mark.parametrize("together", [True, False])
def test_times_a_format_cannot_hold_are_named(tmp_path, name, times, words, together):
    events = np.array([(t, 1, 1, 1) for t in times], EVENT)
    with pytest.raises(ValueError, match=words):
        event_writers.write_pieces(
            tmp_path / name, np.split(events, [] if together else [1]), **SIZE
        )


@pytest.mark.parametrize(("version", "silence"), [("evt3", 2**23), ("evt2", 2**33)])
def test_the_longest_silence_is_read_back(tmp_path, version, silence):
    t = np.cumsum([0, *[silence - 1] * 9, 5])
    events = np.array([(now, 1, 1, 1) for now in t], EVENT)
    path = tmp_path / "a.raw"
    event_writers.write_events(path, events, **SIZE, version=version)
    (piece,) = PropheseeFile(path, ReadOptions()).pieces()
    assert piece.t.tolist() == t.tolist()
    events["t"][5:] += 1
    with pytest.raises(ValueError, match=f"{version.upper()} cannot hold a silence of {silence}"):
        event_writers.write_events(path, events, **SIZE, version=version)
