"""The keys of how a file is read reach the reader from every entry point that reads events."""

import inspect

import numpy as np
import pytest

from src.calibrate import calibrate
from src.convert import convert
from src.live import build_server
from src.reconstruct import reconstruct
from src.recordings.files import ReadOptions, open_recording, read_events, recording_inputs
from tests.recordings.files.tables import quiet_read
from tests.recordings.files.test_table_times import scene, text
from tests.test_recording_entry_points import config

ENTRY_POINTS = {
    "reconstruct": (reconstruct, ["baseline=highpass", "resolution=[24,32]"]),
    "live": (build_server, ["baseline=highpass", "offered_networks=[]"]),
    "calibrate": (calibrate, ["task=views"]),
    "convert": (convert, ["out=/nowhere/a.npz"]),
}


@pytest.fixture
def joined(tmp_path):
    """A file of two recordings, of 0.2 s and of 0.1 s."""
    whole = scene()
    return text(tmp_path / "a.txt", np.concatenate([whole, whole[whole["t"] < 100_000]]))


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"columns": 5}, "columns must be a word, got 5"),
        ({"part": "1"}, "part must be a whole number, got 1"),
        ({"part": True}, "part must be a whole number, got True"),
        ({"stream": 0.5}, "stream must be a number or a name, got 0.5"),
        ({"time_unit": 6}, "time_unit must be a word, got 6"),
    ],
)
def test_another_kind_of_value_is_refused_from_python_too(given, words):
    make = inspect.unwrap(ReadOptions.__init__)  # without the type checks of tests
    with pytest.raises(ValueError, match=words):
        make(object.__new__(ReadOptions), **given)


def test_options_are_read_options(joined):
    opened = inspect.unwrap(open_recording)  # without the type checks of tests
    with pytest.raises(ValueError, match=r"options must be ReadOptions\(\.\.\.\), got {'part': 1}"):
        opened(joined, None, {"part": 1})


@pytest.mark.parametrize("entry_point", ENTRY_POINTS)
@pytest.mark.parametrize(
    ("given", "words"),
    [
        ("time_unit=min", "time_unit must be auto, s, ms, us or ns, got min"),
        ("columns=xyp", "columns must have t, x, y and p once each, got xyp"),
        ("format=evt9", "format must be null, evt2, evt21, evt3, got evt9"),
        ("stream=[0]", "stream must be a number or a name"),
        ("part=2", r"part must be in 0\.\.1, the parts of .*a.txt, got 2"),
        ("part=x", "part must be a whole number, got x"),
    ],
)
def test_a_wrong_value_is_refused(joined, tmp_path, entry_point, given, words):
    work, more = ENTRY_POINTS[entry_point]
    with pytest.raises(ValueError, match=words):
        work(config(entry_point, tmp_path / "run", f"recording={joined}", *more, given))


@pytest.mark.parametrize(("part", "frames"), [(0, 23), (1, 11)])
def test_the_part_that_is_chosen_is_reconstructed(joined, tmp_path, part, frames):
    given = [f"recording={joined}", "baseline=highpass", "output_format=hdf5", f"part={part}"]
    run = reconstruct(config("reconstruct", tmp_path / "run", *given))
    assert len((run / "frames.csv").read_text().splitlines()) == 1 + frames


def test_a_picture_of_the_sensor_and_a_conversion_are_of_the_part_that_is_chosen(joined, tmp_path):
    options = ReadOptions(part=1)
    assert recording_inputs.read_picture_or_event_counts(joined, None, options).sum() == len(
        part := quiet_read(joined, part=1)
    )
    out = tmp_path / "b.npz"
    convert(config("convert", tmp_path / "run", f"recording={joined}", f"out={out}", "part=1"))
    assert np.array_equal(read_events(out), part)


def test_what_is_odd_is_on_the_live_page(joined, tmp_path):
    given = [f"recording={joined}", *ENTRY_POINTS["live"][1]]
    with pytest.warns(UserWarning, match="clock restarts"):
        server = build_server(config("live", tmp_path / "run", *given))
    (line,) = server.page.player.reader.faults.current()
    assert "part=0 of 2 is read (0: 1500 events" in line


def test_a_recording_of_nothing_says_so(tmp_path):
    path = text(tmp_path / "a.txt", scene()[:0])
    assert list(open_recording(path)) == []
    with pytest.raises(ValueError, match=r"a.txt: holds no events"):
        reconstruct(config("reconstruct", tmp_path, f"recording={path}", "baseline=highpass"))
