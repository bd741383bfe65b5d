"""src.convert: the same events in another format, in pieces, whole or not at all."""

import numpy as np
import pytest

from src import convert as entry
from src.recordings.files.recording import open_recording, read_events
from tests.recordings.files import tables
from tests.recordings.files.test_prophesee_file import evt2
from tests.recordings.files.test_recording import made_up
from tests.test_recording_entry_points import config

ENDINGS = [".raw", ".dat", ".aedat4", ".es", ".csv", ".npz", ".h5"]


@pytest.fixture
def convert(tmp_path):
    """Return a call of the entry point's function with the overrides of a command line."""
    return lambda *overrides: entry.convert(config("convert", tmp_path / "run", *overrides))


@pytest.mark.parametrize("source", ENDINGS)
def test_any_format_becomes_any_other(tmp_path, convert, capsys, source):
    events = made_up(3000)
    tables.write_events(tmp_path / f"in{source}", events, width=640, height=480)
    for ending in ENDINGS:
        out = tmp_path / f"out{ending}"
        assert convert(f"recording={tmp_path}/in{source}", f"out={out}") == out
        assert np.array_equal(read_events(out), events), ending
        assert open_recording(out).size == (640, 480)
        seconds = (events["t"][-1] - events["t"][0]) * 1e-6
        assert (
            capsys.readouterr().out
            == f"3000 events, {seconds:.6f} s, 640x480, {out.stat().st_size} bytes: {out}\n"
        )


def test_a_part_of_a_recording(tmp_path, convert):
    events = made_up(3000)
    tables.write_events(tmp_path / "in.npz", events, width=640, height=480)
    convert(f"recording={tmp_path}/in.npz", f"out={tmp_path}/a.h5", "start_s=0.1", "end_s=0.3")
    since = events["t"] - events["t"][0]
    expected = events[(since >= 100_000) & (since < 300_000)]
    assert 500 < len(expected) < 2000
    assert np.array_equal(read_events(tmp_path / "a.h5"), expected)


@pytest.mark.parametrize("out", ["a.csv", "a.raw", "a.h5", "scene"])
def test_times_before_0_are_written_from_0_on(tmp_path, convert, out):
    events = made_up(3000)
    tables.write_events(tmp_path / "in.npz", events, width=640, height=480)
    with np.load(tmp_path / "in.npz") as file:
        columns = dict(file)
    columns["t"] -= 1_500_000
    np.savez(tmp_path / "in.npz", **columns)
    given = f"recording={tmp_path}/in.npz", f"out={tmp_path}/{out}"
    first = int(columns["t"][0])
    if out == "scene":  # its clock starts at 0 whatever the events
        convert(*given, "layout=evreal")
    else:
        with pytest.warns(UserWarning, match=f"times begin at {first} us, written are those"):
            convert(*given)
    events["t"] -= events["t"][0]
    assert np.array_equal(read_events(tmp_path / out), events)


def test_what_the_file_does_not_say_is_stated(tmp_path, convert):
    events = made_up(3000)
    content = b"% plugin_name gen3\n" + evt2(events).tobytes()
    (tmp_path / "IN.RAW").write_bytes(content)
    given = f"recording={tmp_path}/IN.RAW", f"out={tmp_path}/a.npz"
    with pytest.raises(ValueError, match="format must be evt2, evt21 or evt3, got null"):
        convert(*given)
    convert(*given, "format=evt2")
    assert np.array_equal(read_events(tmp_path / "a.npz"), events)


def test_a_folder_for_evreal_and_a_version_of_evt(tmp_path, convert):
    events = made_up(300)
    events["t"][200:] += 20_000_000
    given = f"recording={tmp_path}/in.dat"
    tables.write_events(tmp_path / "in.dat", events, width=640, height=480)
    convert(given, f"out={tmp_path}/scene", "layout=evreal")
    assert np.array_equal(np.load(tmp_path / "scene/events_xy.npy")[:, 1], events["y"])
    with pytest.raises(ValueError, match="EVT3 cannot hold a silence of .*use version=evt2"):
        convert(given, f"out={tmp_path}/a.raw")
    assert not list(tmp_path.glob("a*"))
    convert(given, f"out={tmp_path}/a.raw", "version=evt2")
    assert np.array_equal(read_events(tmp_path / "a.raw"), events)


def test_the_input_is_never_written_over(tmp_path, convert):
    for name in ("a.csv", "b.partial.csv"):
        tables.write_events(tmp_path / name, made_up(30), width=640, height=480)
    (tmp_path / "link.csv").symlink_to(tmp_path / "a.csv")
    before = (tmp_path / "a.csv").read_bytes()
    for source, out in (("a.csv", "a.csv"), ("a.csv", "link.csv"), ("b.partial.csv", "b.csv")):
        with pytest.raises(ValueError, match="out must be another file than recording"):
            convert(f"recording={tmp_path}/{source}", f"out={tmp_path}/{out}")
    assert (tmp_path / "a.csv").read_bytes() == before


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (["out=a.mp4"], "out must end in one of .raw, .*, got a.mp4"),
        (["out=q2"], "out must end in one of .raw, .*, .hdf5, got q2"),
        (["out=a.raw", "version=evt4"], "version must be null, evt2 or evt3, got evt4"),
        (["out=a.h5", "version=evt2"], "version must be null, as a.h5 is no RAW file, got evt2"),
        (["out=a.h5", "start_s=2", "end_s=1"], "start_s must be >= 0 and before end_s, got 2, 1"),
        (["out=a.h5", "layout=x"], "layout must be null or evreal, got x"),
        (["out=a.h5", "sensor_size=[9,9]"], "events are off the 9x9 sensor"),
        (["out=in.csv/a.h5"], "out must be a path that can be written, got in.csv/a.h5: "),
        (["out=a.h5", "format=evt3"], "format must be null, as in.csv is no RAW file"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*states a sensor of")
def test_what_cannot_be_is_named(tmp_path, convert, monkeypatch, overrides, words):
    monkeypatch.chdir(tmp_path)
    tables.write_events(tmp_path / "in.csv", made_up(30), width=640, height=480)
    with pytest.raises(ValueError, match=words):
        convert("recording=in.csv", *overrides)
    assert not (tmp_path / "a.h5").exists()


def test_a_part_without_events_is_refused_and_leaves_no_file(tmp_path, convert):
    tables.write_events(tmp_path / "in.raw", made_up(3000), width=640, height=480)
    with pytest.raises(ValueError, match="recording must have events from 99"):
        convert(f"recording={tmp_path}/in.raw", f"out={tmp_path}/out.npz", "start_s=99")
    assert [file.name for file in tmp_path.glob("out*")] == []


@pytest.mark.parametrize("recording", ["scene", "scene/events"])
def test_nothing_is_written_into_the_folder_that_is_read(tmp_path, convert, recording):
    (tmp_path / "scene/events").mkdir(parents=True)
    events = made_up(3000)
    columns = {name: events[name] for name in "txyp"} | {"size": [640, 480], "time_unit": "us"}
    np.savez(tmp_path / "scene/events/0.npz", **columns)
    given = f"recording={tmp_path}/{recording}"
    with pytest.raises(ValueError, match=f"out must lie outside the folder {given}, got .*cap.npz"):
        convert(given, f"out={tmp_path}/scene/events/cap.npz")
    convert(given, f"out={tmp_path}/cap.npz")
    for path in (tmp_path / recording, tmp_path / "cap.npz"):
        assert np.array_equal(read_events(path), events)
