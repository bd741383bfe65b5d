"""Files of photographs: which count, which are refused, what is told of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from scripts import pack_scenes
from src.sim.scenes import video_files
from src.sim.scenes.photo_files import decode_photograph

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
        with pytest.raises(ValueError, match=f"scene.root must hold readable .* whole .*{name}"):
            decode_photograph(path)
        with pytest.raises(ValueError, match=f"FOLDER must hold readable .* whole .*{name}"):
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
