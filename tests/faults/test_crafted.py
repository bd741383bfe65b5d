"""Files made to harm: small ones that unpack to gigabytes, nest without end or lead elsewhere.

Chance does not find these; each is refused for what it is before it is unpacked, built or followed.
"""

import resource
import struct
import zipfile
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from baselines import upstream
from baselines.firenet import FireNet
from src.models import files
from src.recordings import views
from src.recordings.calibration import alignment
from src.recordings.files import aedat, columns, formats, safe_yaml, sources
from src.sim.scenes import photo_files, pictures, videos
from src.sim.scenes.pictures import LARGEST_PIXELS
from src.simulate import alike
from tests.faults.test_inputs import film, network, unpacked
from tests.recordings.files.test_formats import made_up

GOOD = (
    '<dv version="2.0"><node name="outInfo" path="/"><node name="0" path="/0/">'
    '<attr key="typeIdentifier" type="string">EVTS</attr><node name="info" path="/0/info/">'
    '<attr key="sizeX" type="int">640</attr><attr key="sizeY" type="int">480</attr>'
    "{}</node></node></node></dv>"
)
NONE, LZ4, ZSTD = 0, 1, 3
SPEC = {"target": "src.models.e2vid.E2VID", "kwargs": {"views": 1, "base_channels": 2}}


def aedat4(packing: int, packets: bytes, table: int = -1, inside: str = "") -> bytes:
    """Return an AEDAT4 file: header by hand, then `packets`; `inside` goes into the description."""
    text = GOOD.format(inside).encode()
    places = struct.pack("<HHHHH", 10, 20, 4, 8, 16)
    fields = struct.pack("<iiqI", 16 - 6, packing, table, 4) + struct.pack("<I", len(text)) + text
    header = struct.pack("<I", 16) + b"\0\0" + places + fields + b"\0"
    return aedat.MAGIC + struct.pack("<I", len(header)) + header + packets


def packet(content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<II", 0, len(content) if length is None else length) + content


def zstd_of_one_byte(blocks: int) -> bytes:
    block = ((1 << 17) << 3 | 1 << 1).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd\0\x38" + block * blocks


def lz4_at_the_ratio(blocks: int) -> bytes:
    block = struct.pack("<I", 2**14) + bytes(2**14)
    return b"\x04\x22\x4d\x18\x40\x70\xdf" + block * blocks


FIELDS = struct.pack("<i", 16 - 6)  # where the header says what it holds
BEGIN = len(aedat4(NONE, b""))  # of the packets
DEEP = "<node name='a'>" * 20_000 + "</node>" * 20_000
SKIPPED = b"\x52\x2a\x4d\x18" + struct.pack("<I", 3) + b"abc"
FAR = packet(b"", length=0xFFFFFFF0)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (aedat4(NONE, b"", inside=DEEP), "nested beyond 50 levels"),
        (aedat4(NONE, b"", inside="<attr>"), "description cannot be read"),
        (aedat4(NONE, FAR), "longer than the file"),
        (aedat4(NONE, packet(bytes(8)) + FAR, table=2**40), "longer than the file"),
        (aedat4(ZSTD, zstd_of_one_byte(3000), table=BEGIN), "more than 268435456 bytes"),
        (aedat4(NONE, b"").replace(FIELDS, struct.pack("<i", 99)), "lie before it"),
        (aedat4(NONE, b"").replace(FIELDS, struct.pack("<i", -999)), "header cannot be read"),
        (aedat4(ZSTD, packet(zstd_of_one_byte(3000))), "more than 268435456 bytes"),
        (aedat4(ZSTD, packet(SKIPPED + zstd_of_one_byte(3000))), "more than 268435456 bytes"),
        (aedat4(ZSTD, packet(b"\x27\xb5\x2f\xfd" + bytes(9))), "more than 268435456 bytes"),
        (aedat4(LZ4, packet(lz4_at_the_ratio(80))), "more than 268435456 bytes"),
    ],
)
def test_a_recording_does_not_unpack_without_bound(tmp_path, content, words):
    path = tmp_path / "a.aedat4"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=words):
        formats.read_events(path)


def test_packets_as_they_are_written_are_known(tmp_path):
    for compression in (None, ("lz4", 1), ("zstd", 3)):
        unpacked(tmp_path / "a.aedat4", compression)
        assert len(formats.read_events(tmp_path / "a.aedat4")) == 200
        content = (tmp_path / "a.aedat4").read_bytes()
        first = 18 + int.from_bytes(content[14:18], "little") + 8
        found = aedat._unpacked(content[first:])
        assert found == 0 if compression is None else 200 * 16 < found < 2**19


def write_hdf5(path: Path, count: int, chunk: int | None = None, shape: tuple = (), **more) -> None:
    with h5py.File(path, "w") as file:
        for name in "txyp":
            packed = {"chunks": (chunk,), "compression": "gzip"} if chunk else {}
            file.create_dataset(f"events/{name}", (count, *shape), np.uint16, **packed)
        for name, value in more.items():
            file.create_dataset(name, **value)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"count": 10**12}, "unpacks to"),
        ({"count": 2**28, "chunk": 2**28}, "packed in chunks"),
        ({"count": 9, "shape": (9,)}, "one dimension"),
        ({"count": 9, "t_offset": {"shape": (10**10,), "dtype": "i8"}}, "must be one number"),
    ],
)
def test_a_table_does_not_unpack_without_bound(tmp_path, how, words):
    write_hdf5(tmp_path / "a.h5", **how)
    with pytest.raises(ValueError, match=words):
        formats.read_events(tmp_path / "a.h5", size=(640, 480))


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"shape": (9, 2**14, 2**14), "dtype": "u1"}, "pixels at most"),
        ({"shape": (9, 20, 20), "dtype": "f8"}, "uint8"),
        ({"shape": (400,), "dtype": "u1"}, "uint8"),
    ],
)
def test_a_film_has_frames_of_bounded_size(tmp_path, how, words):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("frames", **how)
    with pytest.raises(ValueError, match=words):
        next(sources.film(tmp_path / "a.h5"))


def test_a_table_leads_to_no_other_file(tmp_path):
    secret = tmp_path / "elsewhere" / "secret.h5"
    formats.write_events(secret, made_up(200), width=640, height=480)
    (tmp_path / "bytes").write_bytes(bytes(64))
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["events"] = h5py.ExternalLink(str(secret), "/events")
    with h5py.File(tmp_path / "external.h5", "w") as file:
        for name in "txyp":
            place = [(str(tmp_path / "bytes"), 0, 64)]
            file.create_dataset(f"events/{name}", (8,), np.int64, external=place)
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((200,), np.int64)
        layout[:] = h5py.VirtualSource(str(secret), "events/t", (200,))
        file.create_virtual_dataset("events/t", layout)
    for name in ("link.h5", "external.h5", "virtual.h5"):
        with pytest.raises(ValueError, match=f"{name}.*other file"):
            formats.read_events(tmp_path / name, size=(640, 480))


@pytest.mark.parametrize("column", ["t", "size"])
def test_an_archive_does_not_unpack_without_bound(tmp_path, column):
    packed = dict.fromkeys("txyp", np.zeros(9, np.int64)) | {column: np.zeros(30_000_000)}
    np.savez_compressed(tmp_path / "a.npz", **packed)
    with pytest.raises(ValueError, match="unpacks to"):
        formats.read_events(tmp_path / "a.npz")
    with pytest.raises(ValueError, match="unpacks to"):
        columns.size(tmp_path / "a.npz")


def test_a_picture_does_not_unpack_without_bound(tmp_path):
    width, height = 2**14, LARGEST_PIXELS // 2**14 + 1
    pack = zlib.compressobj(9)
    rows = b"".join(pack.compress(bytes(width + 1)) for _ in range(height)) + pack.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = [(b"IHDR", head), (b"IDAT", rows), (b"IEND", b"")]
    sealed = [
        struct.pack(">I", len(c)) + n + c + struct.pack(">I", zlib.crc32(n + c)) for n, c in parts
    ]
    path = tmp_path / "a.png"
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(sealed))
    with pytest.raises(ValueError, match="readable picture of at most"):
        sources.sensor_picture(path)
    with pytest.raises(ValueError, match="readable photographs"):
        photo_files.read(path)


GROWING = "a: &a [x, x]\nb: &b [*a, *a]\nc: &c [*b, *b]\n"


def test_a_video_does_not_unpack_without_bound(tmp_path, monkeypatch):
    path = tmp_path / "a.avi"
    film(path)
    monkeypatch.setattr(pictures, "LARGEST_PIXELS", 64 * 48 - 1)
    with pytest.raises(ValueError, match="recording must be a video"):
        next(sources.film(path))
    with pytest.raises(ValueError, match=r"scene\.root must be a video"):
        videos.sources(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (GROWING, "an alias"),
        ("[" * 10_000, "nested beyond 50 levels"),
        ("- " * 10_000 + "x", "nested beyond 50 levels"),
        ("a: " + "1" * 300_000, "longer than 262144 characters"),
        ("a: " + "1" * 5_000, "integer string"),
        ("a: 2001-13-45", "month must be"),
        ("a: 1" + ":59" * 300 + ".0", "too large"),
    ],
)
def test_a_config_does_not_grow_without_bound(tmp_path, text, words):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(safe_yaml.yaml.YAMLError, match=words):
        safe_yaml.read(tmp_path / "a.yaml")
    for read in (
        views.load,
        alignment.read_corners,
        lambda path: alike(OmegaConf.create({"like": str(path)})),
    ):
        with pytest.raises(ValueError, match=r"a\.yaml"):
            read(tmp_path / "a.yaml")


@pytest.mark.parametrize(
    ("sensor", "model"), [((8192, 8192), (9, 9)), ((99, 99), (8192, 8192)), ((99, 9999), (9, 9))]
)
def test_views_have_pictures_of_bounded_size(sensor, model):
    with pytest.raises(ValueError, match=r"views\.(sensor|model) must"):
        views.Views.single(sensor, model)


def test_a_checkpoint_packs_nothing(tmp_path):
    network(tmp_path / "a.ckpt")
    with zipfile.ZipFile(tmp_path / "a.ckpt") as archive:
        parts = {part: archive.read(part) for part in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "packed.ckpt", "w", zipfile.ZIP_DEFLATED) as archive:
        for part, content in parts.items():
            archive.writestr(part, bytes(2**24) if part.endswith("/data/0") else content)
    with pytest.raises(ValueError, match="that is whole"):
        files.load(tmp_path / "packed.ckpt")
    with pytest.raises(ValueError, match="unpacked"):
        upstream.load("firenet", tmp_path / "packed.ckpt")


def test_a_view_of_a_few_numbers_is_no_network(tmp_path):
    wide = FireNet(channels=64).state_dict()
    views = {name: torch.zeros(1).expand(value.shape) for name, value in wide.items()}
    torch.save(
        {"network": SPEC, "state_dict": {f"network.{n}": v for n, v in views.items()}},
        tmp_path / "a.ckpt",
    )
    for load in (files.load, lambda path: upstream.load("firenet", path)):
        with pytest.raises(ValueError, match="hold its weights whole"):
            load(tmp_path / "a.ckpt")


def test_a_pickle_claims_no_memory(tmp_path):
    claims = b"\x80\x02}r" + struct.pack("<I", 0x10000000) + b"."
    with zipfile.ZipFile(tmp_path / "a.pth", "w") as archive:
        archive.writestr("a/data.pkl", claims)
        archive.writestr("a/version", "3\n")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match=r"baseline\.weights"):
        upstream.load("firenet", tmp_path / "a.pth")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # KiB


@pytest.mark.parametrize(
    ("base_channels", "words"), [(4096, "ckpt does not fit"), (10**9, "sizes up to")]
)
def test_a_file_names_no_network_that_fills_the_memory(tmp_path, base_channels, words):
    spec = {"target": SPEC["target"], "kwargs": {"views": 1, "base_channels": base_channels}}
    torch.save({"network": spec, "state_dict": {}}, tmp_path / "a.ckpt")
    with pytest.raises(ValueError, match=words):
        files.load(tmp_path / "a.ckpt")
