"""The pack of photographs: its splits, its budget, its checksums."""

import runpy
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts import pack_scenes
from scripts.pack_scenes import MIB, WORST, verify_pack, write_pack
from src.sim.scenes.clip import SPLITS
from src.sim.scenes.photo_files import decode_photograph, list_photographs
from src.sim.scenes.photographs import Photographs
from tests.conftest import ROOT

PHOTOS = ROOT / "../shared/data/photos"


@pytest.fixture
def folders(tmp_path) -> list[str]:
    """Three folders of 12, 15 and 11 smooth photographs of 60 x 90 px; the last below another."""
    draw, folders = np.random.default_rng(0), []
    for name, count in (("b", 12), ("a", 15), ("c", 11)):
        folder = tmp_path / "photos" / name
        inner = folder / "inner" if name == "c" else folder
        inner.mkdir(parents=True)
        folders.append(str(folder))
        for number in range(count):
            rough = draw.integers(0, 256, (12, 18), np.uint8)
            cv2.imwrite(
                str(inner / f"{number:02}.png"),
                cv2.resize(rough, (90, 60), interpolation=cv2.INTER_CUBIC),
            )
    return folders


def names(photos: list, folder: str) -> list[str]:
    """Names as a pack has them, of what is below the parent of `folder`."""
    return [path.relative_to(Path(folder).parent).as_posix() for path in photos]


def test_the_splits_are_those_of_the_folders_and_training_alone_gets_more(folders, tmp_path):
    out = tmp_path / "new" / "photos.pack"
    line = write_pack(folders[:2], out, side=32, mib=1.0, train_only=folders[2:])
    assert line.startswith(f"{out}: 38 photographs (31 train, 3 val, 4 test), WebP at quality 100")
    for split in SPLITS:
        expected = names(list_photographs(folders[:2], split), folders[0])
        if split == "train":
            expected += [f"c/inner/{number:02}.png" for number in range(11)]
        assert [photo.name for photo in list_photographs(str(out), split)] == expected
    assert [path.name for path in out.parent.iterdir()] == ["photos.pack"]


def test_what_a_link_leads_to_is_named_by_where_it_was_found(folders, tmp_path):
    (Path(folders[0]) / "link").symlink_to(folders[2])
    found = pack_scenes.read_photographs([folders[0]], [], 32)
    assert len(found) == 23 and {"b/00.png", "b/link/inner/10.png"} <= {one.name for one in found}


def test_pictures_are_those_of_the_folders_made_smaller_never_larger(folders, tmp_path):
    for side, shape in ((32, (32, 48)), (200, (60, 90))):
        out = tmp_path / f"{side}.pack"
        write_pack(folders[:1], out, side=side, mib=1.0)
        for ours, theirs in zip(
            list_photographs(str(out), "train"), list_photographs(folders[:1], "train"), strict=True
        ):
            whole = cv2.resize(decode_photograph(theirs), shape[::-1], interpolation=cv2.INTER_AREA)
            assert decode_photograph(ours).shape == shape
            assert np.abs(decode_photograph(ours).astype(float) - whole).mean() < 2.5


def test_the_quality_is_the_best_that_fits(folders, tmp_path):
    sources = pack_scenes.read_photographs(folders, [], 64)
    sizes = [len(pack_scenes.build_pack(pack_scenes._encode(sources, q))) for q in (40, 41)]
    assert sizes[0] < sizes[1]
    for size in sizes:
        quality, content = pack_scenes.encode_within_mib(sources, size / MIB)
        assert len(content) <= size and (quality == 40) == (size == sizes[0])
    tight = write_pack(folders, tmp_path / "tight.pack", side=64, mib=sizes[0] / MIB)
    assert "quality 40," in tight and (tmp_path / "tight.pack").stat().st_size == sizes[0]


def test_a_budget_that_cannot_be_kept_is_refused_before_anything_is_written(folders, tmp_path):
    out = tmp_path / "new" / "small.pack"
    with pytest.raises(ValueError, match=rf"mib must be >= 0.\d\d for 27 .* quality {WORST}.*0.01"):
        write_pack(folders[:2], out, side=60, mib=0.01)
    assert not out.parent.exists()


def test_what_stands_there_stays_where_a_pack_fails(folders, tmp_path):
    out = tmp_path / "photos.pack"
    out.write_bytes(b"before")
    (Path(folders[0]) / "99.jpg").write_bytes(b"no picture")
    with pytest.raises(ValueError, match="FOLDER must hold readable photographs .*99.jpg"):
        write_pack(folders, out, side=32, mib=1.0)
    assert out.read_bytes() == b"before"
    assert not [path for path in tmp_path.iterdir() if "partial" in path.name]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["side=8"], "error: side must be in 16..4096 (px), got 8"),
        (["side=many"], "error: side must be a number, got many"),
        (["mib=0"], "error: mib must be >= 0.0"),
        (["train_only=/nowhere"], "error: scene.extra_train_root must be a folder or a pack of"),
        (["train_only=photos"], "error: scene.extra_train_root must be apart from scene.root"),
        (["quality=5"], "error: key must be side, mib or train_only, got quality"),
    ],
)
def test_the_command_line_is_refused_in_one_line(
    words, message, folders, tmp_path, monkeypatch, capsys
):
    words = [word.replace("=photos", f"={tmp_path}/photos") for word in words]
    monkeypatch.setattr(sys, "argv", ["pack", *folders, str(tmp_path / "out.pack"), *words])
    with pytest.raises(SystemExit) as end:
        runpy.run_path(str(ROOT / "scripts/pack_scenes.py"), run_name="__main__")
    assert end.value.code == 2 and message in capsys.readouterr().err
    assert not (tmp_path / "out.pack").exists()


def test_folders_of_one_name_are_refused(folders, tmp_path):
    with pytest.raises(ValueError, match="FOLDER must differ in name from the others, got b, b"):
        pack_scenes.read_photographs([folders[0], f"{folders[1]}/../b"], [], 32)


@pytest.mark.skipif(not PHOTOS.is_dir(), reason="needs ../shared/data/photos")
def test_the_splits_of_the_real_photographs_come_out_as_they_are(tmp_path):
    folders = [str(PHOTOS / name) for name in ("bsds500_train", "bsds500_val")]
    out = tmp_path / "bsds.pack"
    write_pack(folders, out, side=48, mib=1.0)
    assert verify_pack(out) == 300
    for split in SPLITS:
        packed, files = list_photographs(str(out), split), list_photographs(folders, split)
        assert [photo.name for photo in packed] == names(files, folders[0])
    clip = Photographs(str(out), split="test", frames=2, height=32, width=32).clip(0)
    plain = Photographs(folders, split="test", frames=2, height=32, width=32).clip(0)
    assert clip.name == plain.name
