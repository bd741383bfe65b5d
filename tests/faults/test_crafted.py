"""Files made to harm: small ones that unpack to gigabytes, nest without end or lead elsewhere.

Chance does not find these; each is refused for what it is before it is unpacked, built or followed.
"""

import resource
import struct
import zipfile
import zlib
from functools import partial

import h5py
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from baselines.firenet import FireNet
from src.models import files
from src.recordings import views
from src.recordings.calibration import view_alignment
from src.recordings.files import aedat, columns, formats, sources
from src.records import safe_yaml
from src.sim.scenes import photo_files, video_files
from src.sim.scenes.video_files import LARGEST_PIXELS
from src.simulate import take_clip_config_from_run
from tests.faults import test_damaged_files as whole

DESCRIPTION = (
    '<dv version="2.0"><node name="outInfo" path="/"><node name="0" path="/0/">'
    '<attr key="typeIdentifier" type="string">EVTS</attr><node name="info" path="/0/info/">'
    '<attr key="sizeX" type="int">640</attr><attr key="sizeY" type="int">480</attr>'
    "{}</node></node></node></dv>"
)


def aedat4(packing: int, packets: bytes, table: int = -1, inside: str = "") -> bytes:
    """Return an AEDAT4 file: header by hand, then `packets`; `inside` goes into the description."""
    text = DESCRIPTION.format(inside).encode()
    places = struct.pack("<HHHHH", 10, 20, 4, 8, 16)
    fields = struct.pack("<iiqI", 16 - 6, packing, table, 4) + struct.pack("<I", len(text)) + text
    header = struct.pack("<I", 16) + b"\0\0" + places + fields + b"\0"
    return aedat.MAGIC + struct.pack("<I", len(header)) + header + packets


def packet(content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<II", 0, len(content) if length is None else length) + content


def datasets(path, names, **how):
    with h5py.File(path, "w") as file:
        for name in names:
            file.create_dataset(name, **how)


def table(path, offset=None, **column):
    datasets(path, [f"events/{name}" for name in "txyp"], dtype=np.uint16, **column)
    if offset:
        with h5py.File(path, "a") as file:
            file.create_dataset("t_offset", shape=offset, dtype="i8")


def link(path, virtual):
    secret = path.parent / "secret.h5"
    whole.write_events(secret)
    with h5py.File(path, "w") as file:
        if virtual:
            layout = h5py.VirtualLayout((200,), np.int64)
            layout[:] = h5py.VirtualSource(str(secret), "events/t", (200,))
            file.create_virtual_dataset("events/t", layout)
        else:
            file["events"] = h5py.ExternalLink(str(secret), "/events")


def archive(path, column):
    packed = dict.fromkeys("txyp", np.zeros(9, np.int64)) | {column: np.zeros(30_000_000)}
    np.savez_compressed(path, **packed)


def picture(path):
    width, height, pack = 2**14, LARGEST_PIXELS // 2**14 + 1, zlib.compressobj(9)
    rows = b"".join(pack.compress(bytes(width + 1)) for _ in range(height)) + pack.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n"
    for name, part in ((b"IHDR", head), (b"IDAT", rows), (b"IEND", b"")):
        crc = struct.pack(">I", zlib.crc32(name + part))
        content += struct.pack(">I", len(part)) + name + part + crc
    path.write_bytes(content)


def packed_network(path):
    whole.write_network(path.with_suffix(".whole"))
    with (
        zipfile.ZipFile(path.with_suffix(".whole")) as source,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed,
    ):
        for part in source.namelist():
            content = bytes(2**24) if part.endswith("/data/0") else source.read(part)
            packed.writestr(part, content)


def network(path, state=None, **kwargs):
    spec = whole.SPEC | {"kwargs": {"views": 1, "base_channels": 2} | kwargs}
    torch.save({"network": spec, "state_dict": state or {}}, path)


def expanded_network(path):
    wide = FireNet(channels=64).state_dict()
    network(path, {f"network.{n}": torch.zeros(1).expand(v.shape) for n, v in wide.items()})


def pickle(path):
    with zipfile.ZipFile(path, "w") as file:
        file.writestr("a/data.pkl", b"\x80\x02}r" + struct.pack("<I", 0x10000000) + b".")
        file.writestr("a/version", "3\n")


EMPTY = aedat4(0, b"")  # its packets would begin at its end
FIELDS = struct.pack("<i", 16 - 6)  # where the header says what it holds
FAR = packet(b"", length=0xFFFFFFF0)
SKIPPED = b"\x52\x2a\x4d\x18" + struct.pack("<I", 3) + b"abc"
ZSTD = b"\x28\xb5\x2f\xfd\0\x38" + (((1 << 17) << 3 | 2).to_bytes(3, "little") + b"\0") * 3000
LZ4 = b"\x04\x22\x4d\x18\x40\x70\xdf" + (struct.pack("<I", 2**14) + bytes(2**14)) * 80
DEEP = "<node name='a'>" * 20_000 + "</node>" * 20_000
MUCH, READ = "more than 268435456 bytes", partial(formats.read_events, size=(640, 480))
FRAMES, PUBLISHED = (lambda path: next(sources.read_video(path)),), whole.read_published
CASES = [  # name, content or what writes it, words of the refusal, readers
    ("a.aedat4", aedat4(0, b"", inside=DEEP), "nested beyond 50", [READ]),
    ("a.aedat4", aedat4(0, b"", inside="<attr>"), "description cannot be read", [READ]),
    ("a.aedat4", EMPTY.replace(FIELDS, struct.pack("<i", 99)), "lie before it", [READ]),
    ("a.aedat4", EMPTY.replace(FIELDS, struct.pack("<i", -999)), "header cannot be read", [READ]),
    ("a.aedat4", aedat4(0, FAR), "longer than the file", [READ]),
    ("a.aedat4", aedat4(0, packet(bytes(8)) + FAR, 2**40), "longer than the file", [READ]),
    ("a.aedat4", aedat4(3, ZSTD, table=len(EMPTY)), MUCH, [READ]),
    ("a.aedat4", aedat4(3, packet(ZSTD)), MUCH, [READ]),
    ("a.aedat4", aedat4(3, packet(SKIPPED + ZSTD)), MUCH, [READ]),
    ("a.aedat4", aedat4(3, packet(b"\x27\xb5\x2f\xfd" + bytes(9))), MUCH, [READ]),
    ("a.aedat4", aedat4(1, packet(LZ4)), MUCH, [READ]),
    ("a.h5", partial(table, shape=10**12), "unpacks to", [READ]),
    ("a.h5", partial(table, shape=2**28, chunks=2**28, compression=1), "packed in chunks", [READ]),
    ("a.h5", partial(table, shape=(9, 9)), "one dimension", [READ]),
    ("a.h5", partial(table, shape=9, offset=(10**10,)), "must be one number", [READ]),
    ("a.h5", partial(table, shape=8, external=[("bytes", 0, 64)]), r"a\.h5.*other file", [READ]),
    ("a.h5", partial(link, virtual=True), r"a\.h5.*other file", [READ]),
    ("a.h5", partial(link, virtual=False), r"a\.h5.*other file", [READ]),
    ("a.npz", partial(archive, column="t"), "unpacks to", [READ, columns.read_sensor_size]),
    ("a.npz", partial(archive, column="size"), "unpacks to", [READ, columns.read_sensor_size]),
    ("a.h5", partial(datasets, names=["frames"], shape=(9, 2**14, 2**14), dtype="u1"),
     "pixels at most", FRAMES),
    ("a.h5", partial(datasets, names=["frames"], shape=(9, 9, 9), dtype="f8"), "uint8", FRAMES),
    ("a.h5", partial(datasets, names=["frames"], shape=400, dtype="u1"), "uint8", FRAMES),
    ("a.png", picture, "readable picture of at most", [sources.read_sensor_picture]),
    ("a.png", picture, "readable photographs", [photo_files.read_photograph]),
    ("a.ckpt", packed_network, "that is whole", [files.load]),
    ("a.ckpt", packed_network, "unpacked", [PUBLISHED]),
    ("a.ckpt", expanded_network, "hold its weights whole", [files.load, PUBLISHED]),
    ("a.ckpt", partial(network, base_channels=4096), "ckpt does not fit", [files.load]),
    ("a.ckpt", partial(network, base_channels=10**9), "sizes up to", [files.load]),
    ("a.pth", pickle, r"baseline\.weights", [PUBLISHED]),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "words", "readers"), CASES)
def test_what_is_made_to_harm_is_refused_and_fills_no_memory(
    tmp_path, name, content, words, readers
):
    write = content if callable(content) else lambda path: path.write_bytes(content)
    write(tmp_path / name)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for read in readers:
        with pytest.raises(ValueError, match=words):
            read(tmp_path / name)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


@pytest.mark.parametrize("compression", [None, ("lz4", 1), ("zstd", 3)])
def test_packets_as_they_are_written_are_known(tmp_path, compression):
    whole.write_aedat(tmp_path / "a.aedat4", compression)
    assert len(formats.read_events(tmp_path / "a.aedat4")) == 200
    content = (tmp_path / "a.aedat4").read_bytes()
    found = aedat._unpacked(content[18 + int.from_bytes(content[14:18], "little") + 8 :])
    assert found == 0 if compression is None else 200 * 16 < found < 2**19


def test_a_video_does_not_unpack_without_bound(tmp_path, monkeypatch):
    whole.write_video(tmp_path / "a.avi")
    monkeypatch.setattr(video_files, "LARGEST_PIXELS", 64 * 48 - 1)
    with pytest.raises(ValueError, match="recording must be a video"):
        next(sources.read_video(tmp_path / "a.avi"))
    with pytest.raises(ValueError, match=r"scene\.root must be a video"):
        video_files.find_videos(tmp_path / "a.avi")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n", "an alias"),
        ("[" * 10_000, "nested beyond 50 levels"),
        ("- " * 10_000 + "x", "nested beyond 50 levels"),
        ("a: " + "1" * 300_000, "longer than 262144 characters"),
        ("a: " + "1" * 5_000, "integer string"),
        ("a: 2001-13-45", "month must be"),
        ("a: 1" + ":59" * 300 + ".0", "too large"),
    ],
)
def test_a_config_does_not_grow_without_bound(tmp_path, text, words):
    path = tmp_path / "a.yaml"
    path.write_text(text)
    with pytest.raises(safe_yaml.yaml.YAMLError, match=words):
        safe_yaml.read(path)
    for read in (views.load_views, view_alignment.read_corners):
        with pytest.raises(ValueError, match=r"a\.yaml"):
            read(path)
    with pytest.raises(ValueError, match=r"a\.yaml"):
        take_clip_config_from_run(OmegaConf.create({"like": str(path)}))


@pytest.mark.parametrize(
    ("sensor", "model"), [((8192, 8192), (9, 9)), ((99, 99), (8192, 8192)), ((99, 9999), (9, 9))]
)
def test_views_have_pictures_of_bounded_size(sensor, model):
    with pytest.raises(ValueError, match=r"views\.(sensor|model) must"):
        views.Views.single_view(sensor, model)
