"""Packs of photographs: read as folders are, lazily, and never silently wrong."""

import pickle
import re
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.numpy import save

from scripts.pack_scenes import EncodedPicture, build_pack, verify_pack
from src.sim.scenes import photo_files
from src.sim.scenes.clip import SPLITS
from src.sim.scenes.photo_files import PackedPhotograph, decode_photograph, list_photographs
from src.sim.scenes.photographs import Photographs
from tests.conftest import ROOT


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (40, 48), np.uint8)


def pictures() -> list[EncodedPicture]:
    """Twelve photographs without loss: seven to train on, two to validate, three to test."""
    splits = ["train"] * 7 + ["val"] * 2 + ["test"] * 3
    blobs = [cv2.imencode(".png", picture(number))[1].tobytes() for number in range(12)]
    names = [f"folder/sub/{11 - number:02}.jpg" for number in range(12)]
    return [EncodedPicture(*one, (40, 48)) for one in zip(names, splits, blobs, strict=True)]


@pytest.fixture
def pack(tmp_path) -> Path:
    path = tmp_path / "photos.pack"
    path.write_bytes(build_pack(pictures()))
    return path


def test_a_pack_gives_back_its_pictures_in_order_by_split(pack):
    assert verify_pack(pack) == 12 and build_pack(pictures()) == pack.read_bytes()
    photos = {split: list_photographs(str(pack), split) for split in SPLITS}
    names = [photo.name for split in SPLITS for photo in photos[split]]
    assert [len(photos[split]) for split in SPLITS] == [7, 2, 3]
    assert names == [one.name for one in pictures()] and photos["train"][0].stem == "11"
    for number, photo in enumerate(photo for split in SPLITS for photo in photos[split]):
        assert np.array_equal(decode_photograph(photo), picture(number))


def test_clips_of_a_pack_are_those_of_the_files_in_it(pack, tmp_path):
    for one in pictures():
        path = tmp_path / one.split / Path(one.name).with_suffix(".png").name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(one.data)
    scene = Photographs(str(pack), frames=3, height=32, width=32)
    files = Photographs(str(pack), frames=3, height=32, width=32)
    files.photos = sorted((tmp_path / "train").iterdir(), reverse=True)
    for index in range(4):
        ours, theirs = scene.clip(index), files.clip(index)
        assert torch.equal(ours.frames, theirs.frames) and ours.name == theirs.name


def test_sources_are_the_names_in_the_pack(pack, tmp_path):
    other = shutil.copy(pack, tmp_path / "more.pack")
    for roots, prefix in ((str(pack), ""), ([str(pack), str(other)], "photos.pack/")):
        scene = Photographs(roots, split="test", frames=2, height=8, width=8)
        found = {scene.name_source(photo) for photo in scene.photos}
        assert {f"{prefix}folder/sub/0{number}" for number in range(3)} <= found
        assert scene.clip(0).source in found


def test_a_scene_with_a_pack_travels_to_another_process(pack):
    scene = Photographs(str(pack), frames=2, height=32, width=32)
    scene.clip(0)
    sent = pickle.dumps(scene)
    assert len(sent) < 3000  # no picture in it
    code = (
        "import pickle, sys; scene = pickle.load(sys.stdin.buffer);"
        "sys.stdout.buffer.write(scene.clip(1).frames.numpy().tobytes())"
    )
    done = subprocess.run([sys.executable, "-c", code], input=sent, capture_output=True, cwd=ROOT)
    assert done.stdout == scene.clip(1).frames.numpy().tobytes(), done.stderr.decode()


def test_only_what_is_asked_for_is_read(pack, monkeypatch):
    hashed = []
    plain = photo_files.sha256
    monkeypatch.setattr(photo_files, "sha256", lambda data: hashed.append(data) or plain(data))
    photos = list_photographs(str(pack), "val")
    photos[1].data()
    photos[1].data()
    assert len(hashed) == 3 and hashed[1] == hashed[2] == pictures()[8].data


def damaged(pack: Path, old: bytes, place: int) -> Path:
    """Return a copy with one bit flipped `place` bytes into what is `old` there."""
    whole = bytearray(pack.read_bytes())
    whole[whole.index(old) + place] ^= 1
    path = pack.with_name("damaged.pack")
    path.write_bytes(whole)
    return path


def test_a_damaged_picture_is_named_with_its_file(pack):
    bad = damaged(pack, pictures()[4].data, 50)
    message = f"scene.root: {re.escape(str(bad))} is damaged: the SHA-256 of folder/sub/07.jpg"
    with pytest.raises(ValueError, match=message):
        verify_pack(bad)
    photos = list_photographs(str(bad), "train")
    with pytest.raises(ValueError, match=message):
        decode_photograph(photos[4])
    assert np.array_equal(decode_photograph(photos[5]), picture(5))


def test_a_damaged_index_is_named(pack):
    bad = damaged(pack, b'{"train"', 3)
    with pytest.raises(ValueError, match="damaged.pack is damaged: the SHA-256 of index.json"):
        list_photographs(str(bad), "train")


@pytest.mark.parametrize("kind", ["text", "cut", "other"])
def test_what_is_no_whole_pack_is_refused(kind, pack):
    other = save({"a": np.zeros(3, np.uint8)}, {"format": "pt"})
    content = {"text": b"no pack", "cut": pack.read_bytes()[:-9], "other": other}[kind]
    path = pack.with_name(f"{kind}.pack")
    path.write_bytes(content)
    with pytest.raises(ValueError, match=f"scene.root must be a folder or a pack .*{kind}.pack"):
        Photographs(str(path))


def test_a_split_that_a_pack_lacks_is_named(tmp_path):
    path = tmp_path / "train.pack"
    path.write_bytes(build_pack([one for one in pictures() if one.split == "train"]))
    with pytest.raises(ValueError, match="scene.root must hold photographs of split=val, got"):
        list_photographs(str(path), "val")


def test_a_picture_that_opencv_cannot_read_is_named(tmp_path):
    path = tmp_path / "odd.pack"
    path.write_bytes(build_pack([EncodedPicture("a.jpg", "train", b"not a picture", (40, 48))]))
    with pytest.raises(ValueError, match=r"scene.root must hold readable .*odd.pack: a.jpg"):
        decode_photograph(PackedPhotograph(path, "a.jpg"))
