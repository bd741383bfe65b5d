"""Event files: real recordings, both ways, other decoders, and files that are broken."""

import warnings

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import config

from src.recordings.files.event_file import EVENT
from src.recordings.files.recording import iter_events, open_recording, read_events
from tests.recordings.files.tables import write_events

REAL = {
    "evk3_1280x720_evt3.raw": (219_596, (1280, 720)),
    "gen3_640x480_evt2.raw": (521_252, (640, 480)),
    "dvs.es": (473_225, (320, 240)),
    "dvs_320x240.aedat4": (111_954, (320, 240)),
    "slider_depth/events_chunk.txt": (50_000, None),
    "boxes_rotation/events.txt": (30_000, None),
    "shapes_rotation/events.txt": (20_000, None),
}
ENDINGS = [".raw", ".dat", ".aedat4", ".es", ".csv", ".txt", ".npz", ".h5"]


def made_up(n: int = 2000, seed: int = 0, width: int = 640, height: int = 480) -> np.ndarray:
    g = np.random.default_rng(seed)
    events = np.empty(n, EVENT)
    events["t"] = np.cumsum(g.integers(0, 400, n)) + 1_000_000
    events["x"], events["y"] = g.integers(0, width, n), g.integers(0, height, n)
    events["p"] = g.choice([-1, 1], n)
    return events


@pytest.mark.parametrize("name", REAL)
def test_every_real_recording_is_read_whole(shared_data, name):
    path = shared_data / "events" / name
    count, size = REAL[name]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        events = read_events(path)
    assert len(events) == count and events.dtype == EVENT
    assert open_recording(path).size == size
    assert (np.diff(events["t"]) >= 0).all() and set(np.unique(events["p"])) == {-1, 1}
    pieces = list(iter_events(path, seconds=0.005))
    assert np.array_equal(np.concatenate(pieces), events)
    assert all(piece["t"][-1] - piece["t"][0] < 5000 for piece in pieces)


@pytest.mark.parametrize("ending", ENDINGS)
def test_what_is_written_is_read(tmp_path, ending):
    events = made_up()
    path = tmp_path / f"a{ending}"
    write_events(path, events, width=640, height=480)
    assert open_recording(path).size == (640, 480)
    assert np.array_equal(read_events(path), events)


def test_evt2_is_written_and_told_apart(tmp_path):
    events = made_up()
    write_events(tmp_path / "a.raw", events, width=640, height=480, version="evt2")
    assert b"evt 2.0" in (tmp_path / "a.raw").read_bytes()[:300].lower()
    assert np.array_equal(read_events(tmp_path / "a.raw"), events)


@pytest.mark.parametrize("ending", ENDINGS)
def test_no_events_are_no_events(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    write_events(path, made_up(0), width=640, height=480)
    assert len(read_events(path)) == 0
    assert list(iter_events(path)) == []


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 300), span=st.floats(1e-6, 1.0))
def test_chunks_are_the_whole_whatever_their_length(tmp_path_factory, seed, n, span):
    path = tmp_path_factory.mktemp("chunks") / "a.npz"
    events = made_up(n, seed)
    write_events(path, events, width=640, height=480)
    pieces = list(iter_events(path, seconds=span))
    assert np.array_equal(np.concatenate(pieces), events)
    marks = [(int(p["t"][0]) - int(events["t"][0])) // round(span * 1e6) for p in pieces]
    assert marks == sorted(set(marks))


def test_a_silence_of_years_takes_no_time(tmp_path):
    events = made_up(4)
    events["t"] = [0, 1, 10**15, 10**15 + 1]
    write_events(tmp_path / "a.npz", events, width=640, height=480)
    assert [len(piece) for piece in iter_events(tmp_path / "a.npz", seconds=1e-3)] == [2, 2]


def test_hdf5_in_the_groups_of_others(tmp_path):
    events = made_up(100)
    with h5py.File(tmp_path / "dsec.h5", "w") as file:
        for name in "xyt":
            file[f"events/{name}"] = events[name] - (1_000_000 if name == "t" else 0)
        file["events/p"] = (events["p"] + 1) // 2
        file["t_offset"], file["ms_to_idx"] = 1_000_000, np.arange(3)
    assert np.array_equal(read_events(tmp_path / "dsec.h5"), events)
    with h5py.File(tmp_path / "seconds.h5", "w") as file:
        for name in "xyp":
            file[f"events/{name}s"] = events[name]
        file["events/ts"] = events["t"] * 1e-6
        file.attrs["sensor_resolution"] = (480, 640)
    assert np.array_equal(read_events(tmp_path / "seconds.h5"), events)
    assert open_recording(tmp_path / "seconds.h5").size == (640, 480)


def test_text_of_others(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("240 180\n0.5 1 2 0\n0.6 3 4 1\n")
    assert read_events(path).tolist() == [(500000, 1, 2, -1), (600000, 3, 4, 1)]
    assert open_recording(path).size == (240, 180)
    path = tmp_path / "a.csv"
    path.write_text("x,y,polarity,timestamp\n1,2,-1,50\n3,4,1,60\n")
    assert read_events(path).tolist() == [(50, 1, 2, -1), (60, 3, 4, 1)]


def test_events_that_go_back_or_lie_outside_are_counted(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("t x@10 y@8 p\n100 1 1 1\n90 2 2 1\n110 10 0 0\n120 9 7 0\n")
    with pytest.warns(UserWarning) as heard:
        events = read_events(path)
    assert events["t"].tolist() == [90, 100, 120]
    assert ["1 of 4 events outside 10x8" in str(one.message) for one in heard] == [True]


@pytest.mark.parametrize("ending", [*ENDINGS, ".mp4"])
@pytest.mark.parametrize("content", [b"", b"garbage\n" * 40, b"\x00" * 100])
def test_a_file_that_is_none_is_named(tmp_path, ending, content):
    path = tmp_path / f"a{ending}"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"a{ending}"):
        read_events(path)


@pytest.mark.parametrize("path", [None, np.zeros(3)])
def test_what_is_no_path_is_named(path, monkeypatch):
    monkeypatch.setattr(config, "jaxtyping_disable", True)
    with pytest.raises(ValueError, match="^recording must be a path, got a (NoneType|ndarray)"):
        read_events(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(
        ValueError, match="recording must be an event file, got .*a.raw: no such file"
    ):
        read_events(tmp_path / "a.raw")


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.csv", b"9" * 30 + b",1\nt,x,y,p\n5,3,3,1\n", "sides must be in 1..8192"),
        ("a.aedat4", b"#!AER-DAT4.0\r\n\xb4\x00\x00{" + bytes(99), "longer than the file"),
    ],
)
def test_sizes_that_cannot_be_are_refused(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=words):
        read_events(tmp_path / name)


def test_a_description_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / "a.aedat4"
    write_events(path, made_up(40), width=640, height=480)
    path.write_bytes(path.read_bytes().replace(b"</node>", b"\xff" * 7, 1))
    with pytest.raises(ValueError, match="header cannot be read"):
        read_events(path)


def test_a_packet_longer_than_its_file_is_refused(tmp_path):
    path = tmp_path / "a.aedat4"
    write_events(path, made_up(40), width=640, height=480)
    content = bytearray(path.read_bytes())
    first = 18 + int.from_bytes(content[14:18], "little")
    content[first + 7] = 0x80
    path.write_bytes(content)
    with pytest.raises(ValueError, match="packet of .* longer than the file"):
        read_events(path)


def test_a_truncated_file_is_counted_or_named(tmp_path):
    events = made_up()
    for ending in ENDINGS:
        path = tmp_path / f"a{ending}"
        write_events(path, events, width=640, height=480)
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 2 // 3])
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                read = read_events(path)
            except ValueError as error:
                assert path.name in str(error)
            else:
                assert 0 < len(read) < len(events) or ending == ".aedat4"  # it has one packet
    write_events(tmp_path / "a.raw", events, width=640, height=480)
    (tmp_path / "a.raw").write_bytes((tmp_path / "a.raw").read_bytes()[:-1])
    with pytest.warns(UserWarning, match="truncated"):
        assert 0 < len(read_events(tmp_path / "a.raw")) <= len(events)


@pytest.mark.parametrize(
    ("ending", "version"), [(".raw", "evt2"), (".raw", "evt3"), (".dat", ""), (".es", "")]
)
def test_zeros_at_the_end_of_a_file_are_no_events(tmp_path, ending, version):
    """Room that a recorder took, but never filled."""
    events, path = made_up(), tmp_path / f"a{ending}"
    write_events(path, events, width=640, height=480, **({"version": version} if version else {}))
    whole = path.read_bytes()
    for share, most_lost in ((1.0, 2), (0.5, 1700)):
        kept = whole[: int(share * len(whole))].rstrip(b"\0")
        path.write_bytes(kept + bytes(4000))
        with pytest.warns(
            UserWarning, match="a.*: its last 4000 bytes are zeros, left out"
        ) as said:
            read = read_events(path)
        assert len(said) == 1 and len(events) - most_lost <= len(read) <= len(events)
        assert np.array_equal(read, events[: len(read)])


@pytest.mark.parametrize("kind", ["dvs", "atis"])
def test_an_es_file_that_ends_within_an_event_is_told(tmp_path, kind):
    """Events after 0 and 200 us; before the second is a byte for the silence."""
    head = b"Event Stream" + bytes([2, 0, 0, 1 if kind == "dvs" else 2]) + b"\x08\0\x06\0"
    silence, steps = (b"\xff", (0, 146)) if kind == "dvs" else (b"\xff\xfc", (0, 11 << 2))
    content = head + bytes([steps[0], 3, 0, 4, 0]) + silence + bytes([steps[1], 5, 0, 2, 0])
    path = tmp_path / "a.es"
    for cut in (0, 5):
        path.write_bytes(content[: len(content) - cut])
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            assert len(read_events(path)) == 2 - cut // 5
    for cut in (1, 4, 5 + len(silence) + 2):
        path.write_bytes(content[:-cut])
        with pytest.warns(UserWarning, match="a.es: ends within an event, it is truncated"):
            assert len(read_events(path)) == (cut < 5)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"t": -1}, "times must start at 0"),
        ({"x": 640}, "must lie on 640x480"),
        ({"p": 0}, "polarity must be -1 or 1"),
    ],
)
def test_events_that_cannot_be_written_are_named(tmp_path, change, words):
    events = made_up(10)
    for name, value in change.items():
        events[name][5] = value
    with pytest.raises(ValueError, match=words):
        write_events(tmp_path / "a.raw", events, width=640, height=480)


def test_a_silence_that_evt3_cannot_hold_is_named(tmp_path):
    events = made_up(2)
    events["t"] = [0, 20_000_000]
    with pytest.raises(ValueError, match="EVT3 cannot hold a silence"):
        write_events(tmp_path / "a.raw", events, width=640, height=480)
    write_events(tmp_path / "a.raw", events, width=640, height=480, version="evt2")
    assert read_events(tmp_path / "a.raw")["t"].tolist() == [0, 20_000_000]


def mutated(path, seed: int) -> None:
    """Overwrite, cut or repeat some bytes of a file."""
    g = np.random.default_rng(seed)
    data = bytearray(path.read_bytes())
    for _ in range(int(g.integers(1, 6))):
        at, n = int(g.integers(0, len(data))), int(g.integers(1, 40))
        kind = g.integers(0, 3)
        if kind == 0:
            data[at : at + n] = g.bytes(n)
        elif kind == 1:
            del data[at : at + n]
        else:
            data[at:at] = data[at : at + n]
        data = data or bytearray(b"x")
    path.write_bytes(bytes(data))


def survives(folder, ending: str, seed: int) -> None:
    """Read a mutated file: events on the sensor in order of time, or an error that names it."""
    path = folder / f"a{ending}"
    write_events(path, made_up(300, seed), width=640, height=480)
    mutated(path, seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            events = read_events(path)
            size = open_recording(path).size
        except ValueError as error:
            assert path.name in str(error)
            return
    assert (np.diff(events["t"]) >= 0).all() and np.isin(events["p"], (-1, 1)).all()
    if size is not None and len(events):
        assert events["x"].max() < size[0] and events["y"].max() < size[1]


@pytest.mark.parametrize("ending", ENDINGS)
def test_mutated_files_are_survived(tmp_path, ending):
    for seed in range(12):
        survives(tmp_path, ending, seed)


@pytest.mark.slow
@pytest.mark.parametrize("ending", ENDINGS)
def test_many_mutated_files_are_survived(tmp_path, ending):
    for seed in range(1000, 1400):
        survives(tmp_path, ending, seed)
