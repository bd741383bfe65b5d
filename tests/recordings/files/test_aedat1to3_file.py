"""AEDAT 1.0, 2.0 and 3.1: addresses put together here by the formats' own tables."""

import struct
import warnings
from functools import partial

import numpy as np
import pytest

from src.recordings.files import open_recording, read_events
from src.recordings.files.aedat1to3_file import Aedat1To3File
from tests.recordings.files import raw_events
from tests.recordings.files.raw_events import equal
from tests.recordings.files.test_recording import made_up

DAVIS = b"#!AER-DAT2.0\r\n# HardwareInterface: DAViSFX3\r\n# AEChip: eu.seebetter.ini.chips.davis."
read = partial(raw_events.read, Aedat1To3File)


def words(addresses, t, width: str = ">u4") -> bytes:
    table = np.empty(len(t), [("address", width), ("t", ">u4")])
    table["address"], table["t"] = addresses, np.asarray(t) % 2**32
    return table.tobytes()


def davis(events, width: int, height: int) -> np.ndarray:
    """Return the addresses of events: x from the right, y from below."""
    x, y = (width - 1 - events["x"].astype(int)), (height - 1 - events["y"].astype(int))
    return y << 22 | x << 12 | (events["p"] > 0).astype(int) << 11


def dvs128(events) -> np.ndarray:
    x, y = 127 - events["x"].astype(int), 127 - events["y"].astype(int)
    return y << 8 | x << 1 | (events["p"] < 0)


@pytest.mark.parametrize(
    ("header", "size", "notes"),
    [
        (DAVIS + b"DAVIS240C\r\n#End Of ASCII Header\r\n", (240, 180), 0),
        (DAVIS + b"Davis346blue\r\n", (346, 260), 0),
        (b"#!AER-DAT2.0\r\n# a DAVIS346 of v2e\r\n", (346, 260), 0),
        (b"#!AER-DAT2.0\r\n# Timestamps tick is 1 us\r\n", (346, 260), 1),
        (b"#!AER-DAT2.0\r\n# Timestamps tick is 1 us\r\n", (240, 180), 1),
    ],
)
def test_a_davis_is_read_without_its_frames(tmp_path, header, size, notes):
    events = made_up(3000, width=size[0], height=size[1])
    events["t"] += 2**32 - int(events["t"][2000])  # there the clock goes round
    addresses, t = davis(events, *size), events["t"]
    others = np.array([1 << 31 | 700, 1 << 31 | 3 << 10 | 9, 1 << 10])  # sample, motion, trigger
    addresses = np.concatenate([addresses[:1000], others, addresses[1000:]])
    t = np.concatenate([t[:1000], t[[999] * 3], t[1000:]])
    file, found = read(tmp_path / "a.aedat", header + words(addresses, t))
    assert file.size == size and len(file.notes) == notes and equal(found, events)


@pytest.mark.parametrize("version", ["1.0", "2.0"])
@pytest.mark.parametrize("line", ["# AEChip: ch.unizh.ini.jaer.chip.retina.DVS128\r\n", ""])
def test_a_dvs128(tmp_path, version, line):
    events = made_up(500, width=128, height=128)
    addresses = np.insert(dvs128(events), 100, 0x8000)  # a trigger
    t = np.insert(events["t"], 100, events["t"][99])
    header = f"#!AER-DAT{version}\r\n{line}".encode()
    content = header + words(addresses, t, ">u2" if version == "1.0" else ">u4")
    file, found = read(tmp_path / "a.aedat", content)
    assert file.size == (128, 128) and len(file.notes) == (not line) and equal(found, events)


@pytest.mark.parametrize("line", ["# AEChip: ch.unizh.ini.jaer.chip.retina.DVS640\r\n", ""])
def test_a_dvs640(tmp_path, line):
    events = made_up(500)
    x, y = 639 - events["x"].astype(int), 479 - events["y"].astype(int)
    addresses = y << 11 | x << 1 | (events["p"] > 0)
    content = f"#!AER-DAT2.0\r\n{line}".encode() + words(addresses, events["t"])
    file, found = read(tmp_path / "a.aedat2", content)
    assert file.size == (640, 480) and len(file.notes) == (not line) and equal(found, events)


def test_a_stated_size_counts_for_a_file_that_names_no_camera(tmp_path):
    events = made_up(500, width=346, height=260)
    events = events[(events["x"] >= 110) & (events["y"] >= 85)]  # they fit a DAVIS240, too
    path = tmp_path / "a.aedat2"
    path.write_bytes(b"#!AER-DAT2.0\r\n" + words(davis(events, 346, 260), events["t"]))
    with pytest.warns(UserWarning, match="fit a sensor of 240x180; if it is another, give "):
        guessed = open_recording(path)
    with pytest.warns(UserWarning, match="names no camera"):
        assert np.array_equal(read_events(path, sensor_size=(260, 346)), events)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        larger = read_events(path, sensor_size=(480, 600))  # of no camera that writes such files
    assert np.array_equal(larger["x"], events["x"] - 106)
    assert any("states a sensor of 240x180: read as" in str(one) for one in said)
    (found,) = guessed
    assert guessed.size == (240, 180) and np.array_equal(found["x"], events["x"] - 106)


def test_the_ending_that_jaer_prefers(tmp_path):
    events = made_up(500, width=128, height=128)
    header = b"#!AER-DAT2.0\r\n# AEChip: DVS128\r\n"
    (tmp_path / "a.aedat2").write_bytes(header + words(dvs128(events), events["t"]))
    assert np.array_equal(read_events(tmp_path / "a.aedat2"), events)


def packet(kind: int, source: int, events, rounds: int = 0, valid=1) -> bytes:
    data = events["x"].astype(int) << 17 | events["y"].astype(int) << 2
    data |= (events["p"] > 0).astype(int) << 1 | valid
    body = np.stack([data, events["t"] % 2**31], 1).astype("<u4").tobytes()
    n = len(events)
    return struct.pack("<hhiiiiii", kind, source, 8, 4, rounds, n, n, n) + body


def aedat3(*packets: bytes) -> bytes:
    lines = b"#!AER-DAT3.1\r\n#Format: RAW\r\n#Source 1: DVS128\r\n#Source 2: DAVIS240C\r\n"
    return lines + b"#Start-Time: 2016-01-01\r\n#!END-HEADER\r\n" + b"".join(packets)


def test_packets_of_polarity(tmp_path):
    events, other = made_up(300, width=128, height=128), made_up(50, seed=1, width=240, height=180)
    events["t"][200:] += 2**31
    valid = np.arange(100) % 3 > 0
    content = aedat3(
        packet(1, 1, events[:100], valid=valid), packet(0, 1, events[:9]), packet(1, 2, other),
        packet(1, 1, events[100:200]), packet(1, 1, events[200:], rounds=1),
    )  # fmt: skip
    file, found = read(tmp_path / "a.aedat", content)
    assert file.size == (128, 128) and "0 (dvs128), 1 (davis240c); read is 0" in file.notes[0]
    assert equal(found, np.concatenate([events[:100][valid], events[100:]]))
    file, found = read(tmp_path / "a.aedat", content, stream="davis240c")
    assert file.size == (240, 180) and equal(found, other)


def test_what_is_cut_is_read_as_far_as_it_goes(tmp_path):
    events = made_up(300, width=128, height=128)
    header = b"#!AER-DAT2.0\r\n# AEChip: DVS128\r\n"
    content = header + words(dvs128(events), events["t"])
    with pytest.warns(UserWarning, match="ends within an event"):
        assert equal(read(tmp_path / "a.aedat", content[:-3])[1], events[:-1])
    content = aedat3(packet(1, 1, events[:200]), packet(1, 1, events[200:]))
    for cut in (3, 8 * 100 + 5):
        with pytest.warns(UserWarning, match="ends within a packet"):
            assert equal(read(tmp_path / "a.aedat", content[:-cut])[1], events[:200])


@pytest.mark.parametrize(
    ("content", "words_of_it"),
    [
        (b"#!AER-DAT4.0\r\n" + bytes(80), "must be AEDAT 1.0, 2.0 or 3.1, is AEDAT 4.0"),
        (b"events" * 9, "a file without"),
        (DAVIS + b"DAVIS240C\r\n" + words([1 << 31] * 5, range(5)), "only 5 words of other"),
        (aedat3(packet(3, 1, made_up(9))), "only 1 packets of other"),
        (aedat3(packet(1, 1, made_up(9))).replace(struct.pack("<ii", 8, 4), b"\xff" * 8), "cannot"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, content, words_of_it):
    with pytest.raises(ValueError, match=rf"a\.aedat: .*{words_of_it}"):
        read(tmp_path / "a.aedat", content)
