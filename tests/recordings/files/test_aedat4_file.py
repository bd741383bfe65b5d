"""AEDAT4: packets of one and several streams, packed and cut."""

import struct
from functools import partial

import faery
import numpy as np
import pytest
from faery.file_encoder import events_to_file

from src.recordings.files import aedat4_file as aedat_file
from src.recordings.files.aedat4_file import Aedat4File
from src.recordings.files.event_file import ReadOptions
from tests.recordings.files import raw_events
from tests.recordings.files.raw_events import equal
from tests.recordings.files.test_recording import made_up

STREAM = (
    '<node name="{id}" path="/outInfo/{id}/"><attr key="typeIdentifier" type="string">{kind}</attr>'
    '<node name="info" path=""><attr key="sizeX" type="int">{size[0]}</attr>'
    '<attr key="sizeY" type="int">{size[1]}</attr><attr key="source" type="string">{name}</attr>'
    "</node></node>"
)
read = partial(raw_events.read, Aedat4File)


def faerys(path, events, pieces: int = 1, compression=None) -> bytes:
    """Return a file of 640x480 by faery, of so many packets."""
    listed = np.zeros(len(events), faery.EVENTS_DTYPE)
    for name in "txy":
        listed[name] = events[name]
    listed["on"] = events["p"] > 0
    parts = np.array_split(listed, pieces)
    events_to_file(parts, path, (640, 480), compression=compression, file_type="aedat")
    return path.read_bytes()


def made(*streams: tuple, packets: list[tuple[int, bytes]]) -> bytes:
    """Return a file without packing or table: streams (id, kind, name, size)."""
    parts = (dict(zip(("id", "kind", "name", "size"), part, strict=True)) for part in streams)
    inside = "".join(STREAM.format(**part) for part in parts)
    text = f'<dv version="2.0"><node name="outInfo" path="">{inside}</node></dv>'.encode()
    places = struct.pack("<HHHHH", 10, 20, 4, 8, 16)
    fields = struct.pack("<iiqI", 16 - 6, 0, -1, 4) + struct.pack("<I", len(text)) + text
    header = struct.pack("<I", 16) + b"\0\0" + places + fields + b"\0"
    head = aedat_file.MAGIC + struct.pack("<I", len(header)) + header
    return head + b"".join(struct.pack("<II", id, len(part)) + part for id, part in packets)


def packet(events) -> bytes:
    """Return a FlatBuffers packet of events, with its size before it."""
    listed = np.zeros(len(events), aedat_file.STORED)
    for name in "txy":
        listed[name] = events[name]
    listed["p"] = events["p"] > 0
    table = struct.pack("<HHHxxiII", 6, 8, 4, 8, 4, len(events))
    body = struct.pack("<I", 16) + b"EVTS" + table + listed.tobytes()
    return struct.pack("<I", len(body)) + body


LEFT, RIGHT = (0, "EVTS", "camera_L", (320, 240)), (3, "EVTS", "camera_R", (640, 480))
FRAMES, TRIGGERS = (1, "FRME", "camera_L", (320, 240)), (2, "TRIG", "camera_L", (0, 0))


@pytest.mark.parametrize("compression", [None, ("lz4", 1), ("lz4", 9), ("zstd", 3)])
@pytest.mark.parametrize("pieces", [1, 7])
def test_events_are_what_faery_wrote(tmp_path, compression, pieces):
    events = made_up(3000)
    content = faerys(tmp_path / "a.aedat4", events, pieces, compression)
    file, found = read(tmp_path / "b.aedat4", content)
    assert (file.size, file.time_unit, file.notes) == ((640, 480), "us", ())
    assert equal(found, events)


@pytest.mark.parametrize("share", [0.4, 0.7])
def test_what_is_cut_is_read_up_to_the_last_whole_packet(tmp_path, share):
    events = made_up(3000)
    content = faerys(tmp_path / "a.aedat4", events, 30, ("lz4", 1))
    cut = content[: round(share * len(content))]
    with pytest.warns(UserWarning, match=r"b\.aedat4: ends within a packet, it is truncated"):
        _, found = read(tmp_path / "b.aedat4", cut)
    assert 900 < len(found.t) < 3000 and len(found.t) % 100 == 0
    assert equal(found, events[: len(found.t)])


def test_the_reported_cut_file_gives_its_whole_packets(shared_data):
    with pytest.warns(UserWarning, match="truncated"):
        file, found = read(shared_data / "reported/cut_in_a_packet.aedat4")
    assert len(found.t) == 4000 and file.size == (320, 240)


def test_two_cameras_are_two_streams(tmp_path, shared_data):
    left, right = made_up(300, width=320, height=240), made_up(200, seed=1)
    parts = [(0, packet(left[:99])), (3, packet(right)), (1, b"frame"), (0, packet(left[99:]))]
    content = made(LEFT, FRAMES, RIGHT, packets=parts)
    file, found = read(tmp_path / "a.aedat4", content)
    assert file.size == (320, 240) and equal(found, left)
    assert "2 event streams, 0 (camera_L), 1 (camera_R); read is 0 (stream=0)" in file.notes[0]
    for stream in (1, "1", "camera_R"):
        file, found = read(tmp_path / "a.aedat4", stream=stream)
        assert file.size == (640, 480) and equal(found, right)
    with pytest.raises(ValueError, match=r"stream must be one of 0 \(camera_L\), .*, got 2"):
        read(tmp_path / "a.aedat4", stream=2)
    file, found = read(shared_data / "reported/stereo_two_streams.aedat4")
    _, second = read(shared_data / "reported/stereo_two_streams.aedat4", stream="DVXplorer_R")
    assert len(found.t) == len(second.t) == 6000 and not np.array_equal(found.x, second.x)
    assert "1 (DVXplorer_R)" in file.notes[0]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (made(FRAMES, TRIGGERS, packets=[(1, b"x")]), "no stream of events, only frames, triggers"),
        (made(packets=[]), "no stream of events, only nothing"),
        (made(LEFT, TRIGGERS, packets=[(2, b"x")] * 5), "holds no events, only 5 packets of other"),
        (made(LEFT, packets=[(0, b"garbage" * 9)]), "cannot be decoded"),
        (made(LEFT, packets=[(0, packet(made_up(9))[:-5])]), "cannot be decoded"),
        (made(LEFT, packets=[(0, packet(made_up(9)))])[:-5], "ends within its first packet"),
        (b"#!AER-DAT3.1\r\n" + bytes(80), "does not begin as an AEDAT4 file"),
    ],
)
def test_what_holds_no_events_says_what_it_holds(tmp_path, content, words):
    with pytest.raises(ValueError, match=rf"a\.aedat4: .*{words}"):
        read(tmp_path / "a.aedat4", content)


def test_no_events_are_no_error(tmp_path):
    for name, content in (
        ("a.aedat4", made(LEFT, packets=[])),
        ("b.aedat4", made(LEFT, packets=[(0, packet(made_up(0)))])),
    ):
        (tmp_path / name).write_bytes(content)
        assert list(Aedat4File(tmp_path / name, ReadOptions()).pieces()) == []
