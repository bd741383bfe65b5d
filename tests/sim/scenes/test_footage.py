"""Footage: REDS in its own layout, folders and files; disjoint splits; what is wrong is named."""

import cv2
import numpy as np
import pytest
import torch

from src.app.compose import compose_config
from src.sim.scenes.footage import REDS_SPLIT, Footage, Reds

SMALL = {"height": 16, "width": 16, "frames": 4}


def write_frames(folder, count: int, size=(40, 60)) -> np.ndarray:
    """Write frames whose grey level is 4 times their number, with a lighter left edge."""
    folder.mkdir(parents=True, exist_ok=True)
    video = np.full((count, *size), 4 * np.arange(count)[:, None, None], np.uint8)
    video[:, :, : size[1] // 8] = 250
    for number, frame in enumerate(video):
        cv2.imwrite(str(folder / f"{number:08}.png"), frame)
    return video


def levels(clip) -> list[float]:
    """Return the number of the frame of `write_frames` that each frame of a clip shows."""
    return (clip.frames.mean((1, 2)) * 255 / 4).tolist()


@pytest.fixture(scope="module")
def reds(tmp_path_factory):
    root = tmp_path_factory.mktemp("reds")
    for split in REDS_SPLIT.values():
        for part, number in split:
            (root / part / f"{part}_orig" / f"{number:03}").mkdir(parents=True)
    for part, number in (("train", 0), ("val", 3)):
        write_frames(root / part / f"{part}_orig" / f"{number:03}", 8, (720, 1280))
    return root


def test_reds_is_split_216_27_27_without_overlap():
    parts = [set(part) for part in REDS_SPLIT.values()]
    assert [len(part) for part in parts] == [216, 27, 27]
    everything = {("train", n) for n in range(240)} | {("val", n) for n in range(30)}
    assert set.union(*parts) == everything


def test_reds_shows_the_first_seconds_of_each_sequence(reds):
    clip = Reds(str(reds), split="train", **SMALL).clip(0)
    assert clip.frames.shape == (4, 16, 16) and clip.frames.dtype == torch.float32
    assert np.allclose(levels(clip), [0, 1, 2, 3], atol=0.01) and clip.name == "train-000-0"
    assert Reds(str(reds), split="test", **SMALL).clip(0).name == "val-003-0"
    assert np.allclose(levels(Reds(str(reds), **SMALL).clip(216)), [3, 4, 5, 6], atol=0.01)


def test_reds_fills_the_largest_size_of_the_paper(reds):
    clip = Reds(str(reds), height=768, width=768, frames=2).clip(0)
    assert clip.frames.shape == (2, 768, 768)


def test_pictures_of_12_bits_are_told_and_white_is_what_is_given(tmp_path):
    for number in range(4):
        cv2.imwrite(str(tmp_path / f"{number}.png"), np.full((16, 16), 4095, np.uint16))
    scene = {"root": str(tmp_path), "disjoint_splits": False, **SMALL}
    told = "largest value is 4095 of 65535; scene.white_level=4095 makes 4095 white"
    with pytest.warns(UserWarning, match=told):
        assert np.allclose(Footage(**scene).clip(0).frames, 4095 / 65535)
    assert (Footage(**scene, white_level=4095).clip(0).frames == 1).all()
    with pytest.raises(ValueError, match=r"^scene.white_level must be in \(0, 65535\] or null"):
        Footage(**scene, white_level=0).clip(0)


def test_reds_names_what_is_missing(reds, tmp_path):
    with pytest.raises(ValueError, match="scene.root must hold all 27 sequences of split=test"):
        Reds(str(tmp_path), split="test")
    with pytest.raises(ValueError, match=r"scene.root must hold frames that can be read.*001"):
        Reds(str(reds), **SMALL).clip(1)
    with pytest.raises(ValueError, match="scene.root must be footage that exists, got None"):
        Reds(None)
    with pytest.raises(ValueError, match="must last at most"):
        Reds(str(reds), frames=600)


def test_the_paper_s_recipe_cuts_reds_into_twelve_and_tests_all_of_it(tmp_path):
    for part in REDS_SPLIT.values():
        for home, number in part:
            (tmp_path / f"{home}_orig" / f"{number:03}").mkdir(parents=True)
    cfg = compose_config("train", "experiment=lf3x3", "budget=paper", "scene=reds")
    assert cfg.loss_spike_factor is None and cfg.grad_clip_norm is None
    data = cfg.data
    train, test = (
        Reds(str(tmp_path), split=split, frames=windows + 1, height=32, width=32)
        for split, windows in (("train", data.windows), ("test", data.test_windows))
    )
    assert len(train.segments) == data.epoch_clips == 12 * 216 and len(test.segments) == 27
    assert max(start for _, start in train.segments) + data.windows == 480 == data.test_windows


def test_reds_of_another_size_is_refused(reds):
    write_frames(reds / "train" / "train_orig" / "002", 4, (360, 640))
    with pytest.raises(ValueError, match="must hold frames of 1280x720 px, got 640x360"):
        Reds(str(reds), **SMALL).clip(2)


def test_the_middle_is_cut_out_and_shrunk_by_area(tmp_path):
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 256, (40, 60), np.uint8)
    for number in range(2):
        cv2.imwrite(str(tmp_path / f"{number}.png"), picture)
    options = {"height": 10, "width": 10, "frames": 2, "disjoint_splits": False}
    frame = Footage(str(tmp_path), **options).clip(0).frames[0].numpy()
    middle = picture[:, 10:50].reshape(10, 4, 10, 4).mean((1, 3)) / 255
    assert np.allclose(frame, middle, atol=1e-5)


def test_a_finer_clip_holds_the_coarse_one_and_blends_between(tmp_path):
    write_frames(tmp_path, 12)
    coarse = Footage(str(tmp_path), **SMALL, disjoint_splits=False).clip(1)
    finer = SMALL | {"frames": 10, "fps": 360.0}
    fine = Footage(str(tmp_path), **finer, disjoint_splits=False).clip(1)
    assert torch.equal(coarse.frames, fine.frames[::3])
    assert np.allclose(levels(fine), 3 + np.arange(10) / 3, atol=0.01)


def test_rate_says_how_fast_footage_is(tmp_path):
    write_frames(tmp_path, 20)
    clip = Footage(str(tmp_path), **SMALL, footage_fps=600.0, disjoint_splits=False).clip(0)
    assert np.allclose(levels(clip), [0, 5, 10, 15], atol=0.01)


@pytest.mark.parametrize("videos", [1, 12])
def test_splits_of_any_clip_length_are_disjoint(tmp_path, videos):
    for video in range(videos):
        write_frames(tmp_path / f"{video:02}", 30)
    seen = {}
    for split, frames in (("train", 3), ("val", 2), ("test", 5)):
        scene = Footage(str(tmp_path), split=split, height=16, width=16, frames=frames)
        seen[split] = {(one.name, at + k) for one, at in scene.segments for k in range(frames)}
    assert all(seen.values())
    assert len(set.union(*seen.values())) == sum(map(len, seen.values()))


def test_a_file_gives_the_frames_that_were_written(tmp_path):
    path = tmp_path / "film.avi"
    code = cv2.VideoWriter_fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(path), code, 30.0, (64, 48))
    for number in range(12):
        writer.write(np.full((48, 64, 3), 16 * number, np.uint8))
    writer.release()
    scene = Footage(str(path), **SMALL, disjoint_splits=False)
    found = scene.clip(2).frames.mean((1, 2)) * 255 / 16
    assert np.allclose(found, [6, 7, 8, 9], atol=0.15)
    assert scene.clip(0).name == "film-0"


def broken(tmp_path, kind):
    if kind == "missing":
        return tmp_path / "nothing"
    if kind == "unreadable":
        (tmp_path / "film.mp4").write_bytes(b"no video at all")
        return tmp_path / "film.mp4"
    if kind == "damaged":
        write_frames(tmp_path, 4)
        (tmp_path / "00000002.png").write_bytes(b"no picture")
    if kind in ("short", "small", "mixed"):
        size = (12, 12) if kind == "small" else (40, 40)
        write_frames(tmp_path, 3 if kind == "short" else 4, size)
    if kind == "mixed":
        cv2.imwrite(str(tmp_path / "00000002.png"), np.zeros((50, 50), np.uint8))
    return tmp_path


@pytest.mark.parametrize(
    "kind, message",
    [
        ("missing", "footage that exists"),
        ("empty", "videos or folders of frames, got none"),
        ("unreadable", "a video that FFmpeg can read"),
        ("damaged", "frames that can be read"),
        ("short", "4 frames on end"),
        ("small", "16x16 px or more"),
        ("mixed", "frames of 40x40 px, got 50x50"),
    ],
)
def test_bad_footage_is_named(tmp_path, kind, message):
    with pytest.raises(ValueError, match=f"scene.root must .*{message}"):
        Footage(str(broken(tmp_path, kind)), **SMALL, disjoint_splits=False).clip(0)


def test_an_impossible_frame_rate_is_named(tmp_path):
    with pytest.raises(ValueError, match="scene.footage_fps must be"):
        Footage(str(tmp_path), footage_fps=0.0)


@pytest.mark.parametrize("name", ["street_a", "tennis", "highspeed/pyidi/data/tacoma_bridge.mp4"])
def test_real_footage_moves_little_from_frame_to_frame(shared_data, name):
    root = shared_data / "video" / name
    clip = Footage(str(root), height=128, width=128, frames=9, disjoint_splits=False).clip(1)
    assert float(clip.frames.std()) > 0.05 and float(clip.frames.min()) >= 0
    steps = (clip.frames[1:] - clip.frames[:-1]).abs().mean((1, 2))
    assert 0 < float(steps.max()) < 0.1
