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
from src.recordings.files import recording, recording_inputs, videos
from src.records import safe_yaml
from src.sim.scenes import photo_files, video_decoding, video_files
from src.sim.scenes.video_decoding import LARGEST_PIXELS
from src.simulate import take_clip_config_from_run
from tests.faults import test_damaged_files as whole


def datasets(path, names, **how):
    with h5py.File(path, "w") as file:
        for name in names:
            file.create_dataset(name, **how)


def table(path, beside=None, **column):
    datasets(path, [f"events/{name}" for name in "txyp"], dtype=np.uint16, **column)
    for name, shape in (beside or {}).items():
        with h5py.File(path, "a") as file:
            file.create_dataset(name, shape=shape, dtype="i8")


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


READ = partial(recording.read_events, sensor_size=(480, 640))
FRAMES, PUBLISHED = (lambda path: next(videos.read_video(path)),), whole.read_published
CASES = [  # name, content or what writes it, words of the refusal, readers
    ("a.h5", partial(table, shape=10**12), "unpacks to", [READ]),
    ("a.h5", partial(table, shape=2**28, chunks=2**28, compression=1), "packed in chunks", [READ]),
    ("a.h5", partial(table, shape=(9, 9)), "no columns t, x, y, p", [READ]),
    ("a.h5", partial(table, shape=9, beside={"t_offset": (10**10,)}), "must be one num", [READ]),
    ("a.h5", partial(table, shape=9, beside={"ms_to_idx": (10**12,)}), "unpacks to", [READ]),
    ("a.h5", partial(table, shape=8, external=[("bytes", 0, 64)]), r"a\.h5.*other file", [READ]),
    ("a.h5", partial(link, virtual=True), r"a\.h5.*other file", [READ]),
    ("a.h5", partial(link, virtual=False), r"a\.h5.*other file", [READ]),
    ("a.npz", partial(archive, column="t"), "unpacks to", [READ]),
    ("a.npz", partial(archive, column="size"), "unpacks to", [READ]),
    ("a.h5", partial(datasets, names=["frames"], shape=(9, 2**14, 2**14), dtype="u1"),
     "pixels at most", FRAMES),
    ("a.h5", partial(datasets, names=["frames"], shape=(9, 9, 9), dtype="f8"), "uint8", FRAMES),
    ("a.h5", partial(datasets, names=["frames"], shape=400, dtype="u1"), "uint8", FRAMES),
    ("a.png", picture, "readable picture of", [recording_inputs.read_picture_or_event_counts]),
    ("a.png", picture, "readable photographs", [photo_files.decode_photograph]),
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


def test_a_video_does_not_unpack_without_bound(tmp_path, monkeypatch):
    whole.write_video(tmp_path / "a.avi")
    monkeypatch.setattr(video_decoding, "LARGEST_PIXELS", 64 * 48 - 1)
    with pytest.raises(ValueError, match="recording must be a video"):
        next(videos.read_video(tmp_path / "a.avi"))
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
