"""Recordings made to harm: packets that unpack to gigabytes, lengths and descriptions without end.

Each is refused for what it is before it is unpacked.
"""

import resource
import struct
import warnings

import numpy as np
import pytest
from lz4.frame import LZ4FrameCompressor

from src.recordings.files import read_events, unpacking
from src.recordings.files.aedat1to3_file import Aedat1To3File
from src.recordings.files.aedat4_file import Aedat4File
from src.recordings.files.event_file import ReadOptions
from src.recordings.files.rosbag_file import RosbagFile
from tests.recordings.files.bags import Bag
from tests.recordings.files.test_aedat1to3_file import aedat3, dvs128, words
from tests.recordings.files.test_aedat1to3_file import packet as polarity
from tests.recordings.files.test_aedat4_file import LEFT, made, packet
from tests.recordings.files.test_prophesee_file import evt2, evt21
from tests.recordings.files.test_recording import made_up, mutated

MUCH = "more than 268435456 bytes"
FAR = 0xFFFFFFF0  # bytes of a packet


def lz4_zeros(megabytes: int) -> bytes:
    """Return a frame of zeros, made without as much memory."""
    with LZ4FrameCompressor() as packer:
        parts = [packer.begin(), *(packer.compress(bytes(2**20)) for _ in range(megabytes))]
        return b"".join([*parts, packer.flush()])


def zstd_zeros(megabytes: int) -> bytes:
    """Return a frame of zeros, blocks of one byte that is repeated (RFC 8878)."""
    block = (2**17 << 3 | 2).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd\0\x38" + block * (8 * megabytes)


def packed(kind: int, content: bytes) -> bytes:
    """Return an AEDAT4 file with one packet, packed as `kind` says."""
    file = made(LEFT, packets=[(0, content)])
    return file.replace(struct.pack("<iiqI", 10, 0, -1, 4), struct.pack("<iiqI", 10, kind, -1, 4))


def deep(inside: str) -> bytes:
    return made((0, "EVTS", inside, (9, 9)), packets=[])


def far(content: bytes, length: int = FAR) -> bytes:
    return content + struct.pack("<II", 0, length)


EMPTY = made(LEFT, packets=[])
FIELDS = struct.pack("<i", 10)  # where the header says what it holds
ENTITIES = "".join(f'<!ENTITY a{i + 1} "{f"&a{i};" * 10}">' for i in range(9))
BOMB = f'<!DOCTYPE d [<!ENTITY a0 "lollollol">{ENTITIES}]><dv>&a9;</dv>'.encode()
AEDAT4 = [
    (deep("<node name='a'>" * 20_000 + "</node>" * 20_000), "nested beyond 50"),
    (deep("<attr>"), "description cannot be read"),
    (EMPTY.replace(FIELDS, struct.pack("<i", 99)), "lie before it"),
    (EMPTY.replace(FIELDS, struct.pack("<i", -999)), "header cannot be read"),
    (EMPTY.replace(b"<dv", b"\xff<dv"[:3]), "header cannot be read"),
    (far(EMPTY), "4294967280 bytes is longer than the file"),
    (packed(1, lz4_zeros(300)), MUCH),
    (packed(2, lz4_zeros(300)), MUCH),
    (packed(3, zstd_zeros(300)), MUCH),
    (packed(3, b"\x27\xb5\x2f\xfd" + bytes(9)), "cannot be decoded"),
    (packed(3, b"\x52\x2a\x4d\x18\3\0\0\0abc" + zstd_zeros(300)), "cannot be decoded"),
]


def refuse(read, path, content: bytes, said: str) -> None:
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=said):
        list(read(path, ReadOptions()).pieces())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


@pytest.mark.parametrize(("content", "said"), AEDAT4)
def test_aedat4(tmp_path, content, said):
    refuse(Aedat4File, tmp_path / "a.aedat4", content, said)


def test_a_description_that_grows_is_refused(tmp_path):
    text = made(LEFT, packets=[])[:14]
    places = struct.pack("<HHHHH", 10, 20, 4, 8, 16)
    fields = struct.pack("<iiqI", 10, 0, -1, 4) + struct.pack("<I", len(BOMB)) + BOMB
    header = struct.pack("<I", 16) + b"\0\0" + places + fields + b"\0"
    content = text + struct.pack("<I", len(header)) + header
    refuse(Aedat4File, tmp_path / "a.aedat4", content, "description cannot be read|no stream")


@pytest.mark.parametrize(("size", "count"), [(8, 2**30), (-8, 5), (0, 2**31 - 1), (2**30, 2**30)])
def test_aedat3(tmp_path, size, count):
    content = aedat3(struct.pack("<hhiiiiii", 1, 1, size, 4, 0, count, count, count) + bytes(99))
    refuse(Aedat1To3File, tmp_path / "a.aedat", content, "cannot be")


@pytest.mark.parametrize(("plugin", "packing"), [
    (None, "lz4"), (None, "bz2"), ("mcap", "storage"), ("sqlite3", "message"),
])  # fmt: skip
def test_bags_unpack_within_bounds(tmp_path, monkeypatch, plugin, packing):
    path = tmp_path / ("a" if plugin else "a.bag")
    with Bag(path, plugin, packing) as bag:
        bag.add_array("/dvs/events", made_up(2000))
    assert sum(len(part.t) for part in RosbagFile(path, ReadOptions()).pieces()) == 2000
    monkeypatch.setattr(unpacking, "LARGEST_PACKET", 2**14)
    with pytest.raises(ValueError, match=r"cannot be read as a bag: .* more than 16384 bytes"):
        list(RosbagFile(path, ReadOptions()).pieces())


def test_a_list_that_claims_more_than_its_message_is_refused(tmp_path):
    for name, plugin in (("a.bag", None), ("a", "mcap")):
        with Bag(tmp_path / name, plugin) as bag:
            bag.add_array("/dvs/events", made_up(2))
        file = tmp_path / name if plugin is None else tmp_path / name / "a.mcap"
        count = struct.pack("<III", 480, 640, 2)
        assert count in file.read_bytes()
        broken = file.read_bytes().replace(count, struct.pack("<III", 480, 640, 2**31))
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=r"topic /dvs/events: buffer is smaller"):
            list(RosbagFile(tmp_path / name, ReadOptions()).pieces())


EVENTS = made_up(300, width=128, height=128)
WHOLE = {
    "evt2.raw": b"% evt 2.0\n% geometry 128x128\n" + evt2(EVENTS).tobytes(),
    "evt21.raw": b"% evt 2.1\n% geometry 128x128\n" + evt21(EVENTS).tobytes(),
    "dvs.aedat": b"#!AER-DAT2.0\r\n" + words(dvs128(EVENTS), EVENTS["t"]),
    "caer.aedat": aedat3(polarity(1, 1, EVENTS[:99]), polarity(1, 1, EVENTS[99:])),
    "two.aedat4": made(LEFT, packets=[(0, packet(EVENTS[:99])), (0, packet(EVENTS[99:]))]),
}


@pytest.mark.parametrize("name", WHOLE)
def test_mutated_recordings_are_read_or_named(tmp_path, name):
    for seed in range(25):
        (tmp_path / name).write_bytes(WHOLE[name])
        mutated(tmp_path / name, seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                events = read_events(tmp_path / name)
            except ValueError as error:
                assert name in str(error)
            else:
                assert (np.diff(events["t"]) >= 0).all() and np.isin(events["p"], (-1, 1)).all()
