"""Bags of ROS 1 and 2: events, topics and encodings as rosbags wrote them."""

from functools import partial

import numpy as np
import pytest

from src.recordings.files import read_events, recording_inputs
from src.recordings.files.event_file import ReadOptions
from src.recordings.files.event_writers import write_events
from src.recordings.files.rosbag_file import RosbagFile
from tests.recordings.files import raw_events
from tests.recordings.files.bags import ARRAYS, PACKETS, Bag
from tests.recordings.files.raw_events import equal
from tests.recordings.files.test_recording import made_up

KINDS = [(".bag", None), ("", "sqlite3"), (".db3", "sqlite3"), ("", "mcap"), (".mcap", "mcap")]
read = partial(raw_events.read, RosbagFile)


def bag_at(folder, ending: str):
    """Return where the bag is written, and what is read of it."""
    path = folder / f"cap{ending if ending == '.bag' else ''}"
    return path, path if ending in ("", ".bag") else path / f"cap{ending}"


@pytest.mark.parametrize(("ending", "plugin"), KINDS)
@pytest.mark.parametrize(
    ("name", "frame"), [(ARRAYS[0], "camera"), (ARRAYS[1], "cam"), (ARRAYS[2], "c")]
)  # shift
def test_arrays_are_what_rosbags_wrote(tmp_path, ending, plugin, name, frame):
    events = made_up(400)
    events["t"] = events["t"] * 1000 + 1_700_000_000_000_000_007
    path, source = bag_at(tmp_path, ending)
    with Bag(path, plugin) as bag:
        for part in (events[:1], events[1:3], events[:0], events[3:]):
            bag.add_array("/dvs/events", part, name, frame)
    file, found = read(source)
    assert (file.size, file.time_unit, file.notes) == ((640, 480), "ns", ())
    assert equal(found, events)


@pytest.mark.parametrize(("ending", "plugin"), KINDS)
@pytest.mark.parametrize(("kind", "big"), [(PACKETS[0], False), (PACKETS[1], True)])
def test_packets_of_prophesees_words(tmp_path, ending, plugin, kind, big):
    events = made_up(3000)
    events["t"] -= events["t"][0]
    write_events(tmp_path / "a.raw", events, width=640, height=480)
    words = np.frombuffer((tmp_path / "a.raw").read_bytes().partition(b"% t0 0\n")[2], "<u2")
    words = words.byteswap() if big else words
    path, source = bag_at(tmp_path, ending)
    with Bag(path, plugin) as bag:
        for part in np.array_split(words, 7):
            bag.add_packet("/events", part.tobytes(), "evt3", big=big, kind=kind)
    file, found = read(source)
    assert file.time_unit == "us" and equal(found, events)


@pytest.mark.parametrize("big", [False, True])
def test_packets_of_a_word_an_event(tmp_path, big):
    events = made_up(100)
    base = 1_700_000_000_000_000_000
    words = events["t"].astype(np.uint64) | events["x"].astype(np.uint64) << 32
    words |= events["y"].astype(np.uint64) << 48 | (events["p"] > 0).astype(np.uint64) << 63
    words = words.byteswap() if big else words
    with Bag(tmp_path / "cap", "mcap") as bag:
        bag.add_packet("/events", words.tobytes(), "mono", base, big)
    events["t"] += base
    file, found = read(tmp_path / "cap")
    assert file.time_unit == "ns" and equal(found, events)


def test_packets_of_libcaer_whose_clock_goes_round(tmp_path):
    # bit 0 valid, 1 ON, from 2 y, from 17 x; microseconds of 31 bits
    events = [(5, 7, 1, 2**31 - 2), (639, 0, 0, 2**31 - 1), (1, 479, 1, 3)]
    words = [word for x, y, on, t in events for word in (x << 17 | y << 2 | on << 1 | 1, t)]
    with Bag(tmp_path / "cap", "mcap") as bag:
        bag.add_packet("/events", np.array(words, "<u4").tobytes(), "libcaer", 1000, big=True)
        bag.add_packet("/events", np.array(words[4:], "<u4").tobytes(), "libcaer", 2**31 * 1000)
    file, found = read(tmp_path / "cap")
    assert (file.size, file.time_unit) == ((640, 480), "ns")
    assert [int(t) // 1000 - 2**31 for t in found.t] == [-1, 0, 4, 3]
    assert found.x.tolist() == [5, 639, 1, 1] and found.y.tolist() == [7, 0, 479, 479]
    assert found.p.tolist() == [1, 0, 1, 1]


@pytest.mark.parametrize("big", [False, True])
def test_packed_packets_of_libcaer(tmp_path, big):
    high, low, column, row, first, rows = (kind << 12 for kind in range(6))
    on = 1 << 11
    words = [
        high | 1, low | 5, column | 300, row | on | 250, low | 6, row | 4, column | 2,
        first | on | 8, rows | 0b10000001, rows | 0b10, first, rows | 1, row | 9,
    ]  # fmt: skip
    content = np.array(words, ">u2" if big else "<u2").tobytes()
    with Bag(tmp_path / "cap", "mcap") as bag:
        bag.add_packet("/events", content, "libcaer_cmp", 10**18, big)
    file, found = read(tmp_path / "cap")
    assert file.time_unit == "ns"
    assert ((found.t - 10**18) // 1000).tolist() == [4101, *[4102] * 6]
    assert found.x.tolist() == [300, 300, 2, 2, 2, 2, 2]
    assert found.y.tolist() == [250, 4, 8, 15, 17, 0, 9]
    assert found.p.tolist() == [1, 0, 1, 1, 1, 0, 0]


@pytest.mark.parametrize(("encoding", "size", "base", "fault"), [
    ("libcaer", 12, 0, "cannot reshape"), ("libcaer_cmp", 3, 0, "buffer size"),
    ("libcaer_cmp", 2, 0, "a word of kind 6"), ("libcaer_cmp", 4, 0, "before the word of"),
    ("libcaer", 8, 2**63, "time_base must be in"),
    ("mono", 8, 2**64 - 1, "time_base must be in"),
])  # fmt: skip
def test_packets_that_cannot_be_are_named(tmp_path, encoding, size, base, fault):
    content = b"\0\x30\0\x10" if size == 4 else b"\0\x60" * 6  # a row without a column
    with Bag(tmp_path / "cap", "mcap") as bag:
        bag.add_packet("/events", content[:size], encoding, base)
    with pytest.raises(ValueError, match=f"cap: topic /events: .*{fault}"):
        read(tmp_path / "cap")


@pytest.mark.parametrize(("plugin", "packing"), [
    (None, "lz4"), (None, "bz2"), ("sqlite3", "file"), ("sqlite3", "message"), ("mcap", "storage"),
])  # fmt: skip
def test_packed_bags(tmp_path, plugin, packing):
    events = made_up(300)
    path = tmp_path / ("cap" if plugin else "cap.bag")
    with Bag(path, plugin, packing) as bag:
        bag.add_array("/dvs/events", events)
    assert equal(read(path)[1], events)


@pytest.mark.parametrize("plugin", [None, "sqlite3"])
def test_topics_are_streams(tmp_path, plugin):
    few, many = made_up(20), made_up(500, seed=1)
    path = tmp_path / ("cap" if plugin else "cap.bag")
    with Bag(path, plugin) as bag:
        bag.add_array("/left", few)
        bag.add_array("/right", many)
        bag.add("/info", "std_msgs/msg/Header", bag.header())
    file, found = read(path)
    assert equal(found, many)
    assert "2 event streams, 0 (/left), 1 (/right); read is 1" in file.notes[0]
    assert equal(read(path, stream=0)[1], few) and equal(read(path, stream="/left")[1], few)
    with pytest.raises(ValueError, match=r"stream must be one of 0 \(/left\), .* got /x"):
        read(path, stream="/x")


def test_a_later_message_may_state_the_size(tmp_path):
    parts = np.array_split(made_up(300), 3)
    with Bag(tmp_path / "a.bag", None) as bag:
        for size, part in zip([(0, 0), (0, 640), (480, 640)], parts, strict=True):
            bag.add_array("/dvs/events", part, size=size)
    assert RosbagFile(tmp_path / "a.bag", ReadOptions()).size == (640, 480)


def test_a_folder_is_a_recording(tmp_path):
    events = made_up(300)
    listed = events.copy()
    listed["t"] *= 1000
    with Bag(tmp_path / "2026_11_26", "mcap") as bag:
        bag.add_array("/dvs/events", listed)
    assert recording_inputs.has_events(tmp_path / "2026_11_26") and not recording_inputs.has_events(
        tmp_path
    )
    assert recording_inputs.find_sensor_size(tmp_path / "2026_11_26") == (480, 640)
    assert np.array_equal(read_events(tmp_path / "2026_11_26"), events)


def test_what_is_not_read_is_named(tmp_path):
    with Bag(tmp_path / "a.bag", None) as bag:
        bag.add("/info", "std_msgs/msg/Header", bag.header())
    with pytest.raises(ValueError, match=r"a\.bag: holds no messages of events, only std_msgs"):
        read(tmp_path / "a.bag")
    with Bag(tmp_path / "b", "mcap") as bag:
        bag.add_packet("/events", bytes(8), "evt4")
    with pytest.raises(ValueError, match="b: topic /events: encoding 'evt4' is not read, but evt3"):
        read(tmp_path / "b")


@pytest.mark.parametrize(("ending", "plugin"), KINDS)
def test_broken_bags_are_named(tmp_path, ending, plugin):
    path, source = bag_at(tmp_path, ending)
    with Bag(path, plugin) as bag:
        bag.add_array("/dvs/events", made_up(300))
    part = (
        source if source.is_file() else next(file for file in path.iterdir() if "cap" in file.name)
    )
    content, g = part.read_bytes(), np.random.default_rng(0)
    for cut in g.integers(0, len(content), 30):
        noise = bytearray(content)
        noise[cut : cut + 9] = g.bytes(9)
        for broken in (content[:cut], bytes(noise)):
            part.write_bytes(broken)
            try:
                read(source)
            except ValueError as error:
                assert source.name in str(error)
