"""Files of photographs: which count, which are refused, what is told of them."""

from itertools import chain
from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts import pack_scenes
from src.sim.scenes import photo_files, video_files
from src.sim.scenes.clip import SPLITS
from src.sim.scenes.photo_files import decode_photograph, list_photographs
from src.sim.scenes.photographs import Photographs

ROUGH = np.random.default_rng(0).integers(0, 256, (40, 60), np.uint8)
END = b"\xff\xd9"  # of a JPEG


def jpeg(*, progressive: bool = False, thumbnail: bytes = b"") -> bytes:
    """Return a JPEG, with another one in a segment before its first scan."""
    asked = [cv2.IMWRITE_JPEG_PROGRESSIVE, int(progressive)]
    data = cv2.imencode(".jpg", ROUGH, asked)[1].tobytes()
    if not thumbnail:
        return data
    fill, size = b"\xff", (len(thumbnail) + 2).to_bytes(2, "big")  # any number of fill bytes
    return data[:2] + fill + b"\xff\xe1" + size + thumbnail + data[2:]


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.95, 0.9999])
def test_a_jpeg_that_is_cut_short_is_named(progressive, share, tmp_path):
    for name, thumbnail in (("plain.jpg", b""), ("thumbnail.jpg", jpeg())):
        data = jpeg(progressive=progressive, thumbnail=thumbnail)
        path = written(tmp_path / name, data[: int(len(data) * share)])
        with pytest.raises(
            ValueError, match=f"scene.root must hold readable .* none cut short, .*{name}"
        ):
            decode_photograph(path)
        with pytest.raises(
            ValueError, match=f"FOLDER must hold readable .* none cut short, .*{name}"
        ):
            pack_scenes._read_shrunk(path, 32)
        assert video_files.read_picture(path.read_bytes()) is None


@pytest.mark.parametrize("progressive", [False, True])
def test_a_whole_jpeg_is_read_whatever_follows_it(progressive, tmp_path):
    plain = jpeg(progressive=progressive)
    expected = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_GRAYSCALE)
    for n, data in enumerate((plain, jpeg(progressive=progressive, thumbnail=jpeg()))):
        for follows in (b"", bytes(3), bytes(10**5) + plain[: len(plain) // 2]):
            path = written(tmp_path / f"{n}-{len(follows)}.jpg", data + follows)
            assert np.array_equal(decode_photograph(path), expected)


def test_a_file_whose_start_alone_is_of_a_jpeg_is_refused(tmp_path):
    for n, rest in enumerate((b"", b"\xff", b"\xff\xda", b"\xff\xff\xff", b"\xff\xe1\0\0", END)):
        path = written(tmp_path / f"{n}.jpg", b"\xff\xd8" + rest)
        with pytest.raises(ValueError, match=f"scene.root must hold readable .*{n}.jpg"):
            decode_photograph(path)


def folder(path: Path, count: int = 12) -> Path:
    path.mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(path / f"{number:02}.png"), ROUGH + number)
    return path


def splits(root: Path) -> dict[str, list[str]]:
    """Return the names below `root` of the photographs of each split."""
    photos = {split: list_photographs(str(root), split) for split in SPLITS}
    return {s: [photo.relative_to(root).as_posix() for photo in photos[s]] for s in SPLITS}


def test_hidden_files_and_folders_are_no_photographs(tmp_path):
    root = folder(tmp_path / "a")
    before = splits(root)
    written(root / "._00.png", b"of macOS")
    folder(root / ".thumbnails")
    (root / "03-folder.png").mkdir()
    assert splits(root) == before and len([*chain(*before.values())]) == 12
    hidden = folder(tmp_path / ".data")
    assert splits(hidden) == before


def test_a_file_in_two_places_is_refused(tmp_path):
    root, linked = folder(tmp_path / "a"), tmp_path / "links"
    linked.mkdir()
    for path in root.iterdir():
        (linked / f"of_{path.name}").symlink_to(path)
    wanted = (
        "scene.root must hold each photograph once, got .*/links/of_00.png, which is .*/a/00.png"
    )
    with pytest.raises(ValueError, match=wanted):
        Photographs([str(root), str(linked)])
    (root / "last.png").symlink_to(root / "03.png")
    with pytest.raises(ValueError, match=r"photograph once, got .*last.png, which is .*a/03.png"):
        Photographs(str(root), split="test")
    (root / "last.png").unlink()
    wanted = "extra_train_root must be apart from scene.root, got .*of_00.png, which is .*/a/00.png"
    with pytest.raises(ValueError, match=wanted):
        Photographs(str(root), extra_train_root=str(linked))
    assert len(Photographs(str(linked)).photos) == 9


def test_pictures_of_one_stem_are_in_one_split(tmp_path):
    root = folder(tmp_path / "a", 30)
    before = splits(root)
    for name in ("03.jpg", "04.jpg", "04.tif", "07.jpg"):
        cv2.imwrite(str(root / name), ROUGH)
    cv2.imwrite(str(root / "04.k.bmp"), ROUGH)  # another one, between those of 04 in the list
    (root / "05.png").unlink()
    after = splits(root)
    assert {"04.jpg", "04.png", "04.tif"} <= set(after["val"]) and "07.jpg" in after["test"]
    stems = [{name[:-4] for name in after[split]} for split in SPLITS]
    assert stems == [
        {name[:-4].replace("05", "04.k") for name in before[split]} for split in SPLITS
    ]
    scene = Photographs(str(root), split="val")
    assert {scene.name_source(photo) for photo in scene.photos} == stems[1]


def test_linked_folders_are_searched_and_loops_end(tmp_path):
    folder(tmp_path / "elsewhere/more", 4)
    root = folder(tmp_path / "a/inner").parent
    (root / "link").symlink_to(tmp_path / "elsewhere")
    expected = splits(root)
    (root / "loop").symlink_to(root)
    (root / "inner/up").symlink_to(tmp_path)
    (tmp_path / "elsewhere/back").symlink_to(root)
    (root / "broken.png").symlink_to(tmp_path / "none.png")
    found = splits(root)
    assert found == expected and len([*chain(*found.values())]) == 16
    assert "link/more/03.png" in [*chain(*found.values())]


def test_webp_counts_and_what_counts_is_said(tmp_path):
    root = tmp_path / "a"
    root.mkdir()
    for number in range(10):
        cv2.imwrite(str(root / f"{number}.webp"), ROUGH)
    assert len(Photographs(str(root)).photos) == 7
    (root / "0.webp").rename(root / "0.heic")
    with pytest.raises(ValueError, match=r"10 photographs, got 9 in .*a \(.bmp, .* .webp count\)"):
        Photographs(str(root))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"hold photographs, got none in .* \(.bmp, .* count\)"):
        Photographs(None, extra_train_root=str(tmp_path / "empty"))


def test_a_dark_photograph_of_12_bits_is_told_once_and_read_as_it_was(tmp_path):
    path = tmp_path / "dark.png"
    cv2.imwrite(str(path), ROUGH.astype(np.uint16) * 16)
    told = r"dark.png: its largest value is 40\d\d of 65535; times 16 it fills the range"
    with pytest.warns(UserWarning, match=told) as caught:
        read = [photo_files.read_luminance(path) for _ in range(3)]
    assert len(caught) == 1 and np.array_equal(read[2], ROUGH // 16)
    cv2.imwrite(str(tmp_path / "deep.png"), ROUGH.astype(np.uint16) * 257)
    assert np.abs(decode_photograph(tmp_path / "deep.png").astype(int) - ROUGH).max() <= 1


@pytest.mark.parametrize("suffix", ["png", "webp"])
def test_transparent_pixels_of_photographs_are_told_once(suffix, tmp_path):
    path, opaque = tmp_path / f"clear.{suffix}", tmp_path / f"opaque.{suffix}"
    pixels = np.dstack([ROUGH] * 3 + [np.full_like(ROUGH, 255)])
    cv2.imwrite(str(opaque), pixels)
    assert decode_photograph(opaque) is not None
    pixels[:, :9] = 0
    cv2.imwrite(str(path), pixels)
    with pytest.warns(UserWarning, match=f"clear.{suffix}: transparent pixels show") as caught:
        for _ in range(3):
            pack_scenes._read_shrunk(path, 32)
            photo_files.read_luminance(path)
    assert len(caught) == 1
