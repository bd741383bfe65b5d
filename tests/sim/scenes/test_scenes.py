"""Scenes are functions of index and time; photographs move smoothly and have disjoint splits."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from src.sim.scenes.clip import Clip, FrameRateMixture, SceneBase
from src.sim.scenes.moving_layers import SimilarityMotion
from src.sim.scenes.photo_files import EMBEDDED, list_photographs
from src.sim.scenes.photographs import Photographs
from src.sim.scenes.targets import TARGETS, Targets
from src.sim.scenes.targets_on_photographs import TargetsOnPhotographs
from tests.sim.scenes.test_static_camera import ALL, SMALL

SCENES = {
    "photographs": Photographs,
    "static camera": partial(Photographs, **SMALL, paused_clip_share=0.5),
    "rests": partial(Photographs, paused_clip_share=1.0, static_camera_share=0.5),
    "targets": partial(TargetsOnPhotographs, kinds=ALL, paused_clip_share=0.5, max_targets=3),
    **{kind: partial(Targets, kinds=[kind]) for kind in TARGETS},
}


@pytest.mark.parametrize("kind", SCENES)
def test_a_clip_is_a_function_of_seed_split_and_index(kind):
    def clip(index=3, **options) -> Clip:
        return SCENES[kind](frames=4, height=64, width=80, **options).clip(index)

    first, again = clip(), clip()
    assert torch.equal(first.frames, again.frames) and first.name == again.name
    assert first.frames.shape == (4, 64, 80) and first.frames.dtype == torch.float32
    assert float(first.frames.min()) >= 0 and float(first.frames.max()) <= 1 and first.fps == 120.0
    for other in (clip(4), clip(seed=1), clip(split="test")):
        name = "frames" if first.path_px is None else "path_px"
        assert not torch.equal(getattr(first, name), getattr(other, name))


@pytest.mark.parametrize("kind", SCENES)
def test_a_clip_is_a_function_of_time(kind):
    """A finer clip holds the coarse one, a longer one the shorter."""
    size = {"height": 64, "width": 80}
    for index in range(4):
        clip = SCENES[kind](frames=5, fps=120.0, **size).clip(index)
        fine = SCENES[kind](frames=13, fps=360.0, **size).clip(index)
        longer = SCENES[kind](frames=9, fps=120.0, **size).clip(index)
        torch.testing.assert_close(clip.frames, fine.frames[::3], atol=1e-5, rtol=0)
        assert torch.equal(longer.frames[:5], clip.frames)
        if clip.path_px is not None:
            torch.testing.assert_close(clip.path_px, fine.path_px[::3], atol=1e-4, rtol=0)


def test_a_clip_says_which_photograph_it_shows():
    for index in range(6):
        clip = Photographs(split="test", frames=2, height=32, width=32).clip(index)
        assert clip.name == f"{clip.source}-{index}" and clip.source in EMBEDDED["test"].split()
    drawn = Targets(kinds=["dart"], split="test", frames=2, height=32, width=32).clip(0)
    assert drawn.source == ""


def sources(root, split="test", **more) -> set[str]:
    """Return the sources of the photographs, of which three clips show some."""
    scene = Photographs(root, split=split, frames=2, height=8, width=8, max_cutouts=0, **more)
    found = {scene.name_source(photo) for photo in scene.photos}
    for index, clip in enumerate(map(scene.clip, range(3))):
        assert clip.source in found and clip.name == f"{Path(clip.source).name}-{index}"
    return found


def test_photographs_of_one_name_in_other_folders_are_other_sources(tmp_path):
    for number in range(20):
        folder(tmp_path / f"{number:02}", 1)
    assert sources(str(tmp_path)) == {f"{number:02}/000" for number in (7, 9, 17, 19)}


def test_sources_name_their_root_where_there_are_several(tmp_path):
    for parent in "ab":
        (tmp_path / parent).mkdir()
    roots = [folder(tmp_path / place, 10) for place in ("a/x", "b/x", "y")]
    assert sources(roots[0]) == {"007", "009"}
    assert sources(roots[1:]) == {f"{name}/00{n}" for name in "xy" for n in (7, 9)}
    assert sources(roots[:2]) == {f"{name}/x/00{n}" for name in "ab" for n in (7, 9)}
    lexical = [f"{tmp_path}/a/x", f"{tmp_path}/a/x/../../y"]
    assert sources(lexical) == {f"{name}/00{n}" for name in "xy" for n in (7, 9)}
    more = sources(roots[0], "train", extra_train_root=[roots[1], roots[1]])
    assert more == {f"a/x/00{n}" for n in (0, 1, 2, 3, 5, 6, 8)} | {f"b/x/00{n}" for n in range(10)}


def test_motion_is_smooth_and_of_the_stated_speed():
    """Halving the frame interval halves the change from frame to frame: nothing jumps."""
    given = {"frames": 9, "speed_widths_per_s": (0.5, 0.5), "max_cutouts": 0}
    slow, fast = Photographs(fps=120.0, **given), Photographs(fps=240.0, **given)
    for index in range(4):
        pair = (scene.clip(index).frames for scene in (slow, fast))
        steps = [float(frames.diff(dim=0).abs().mean()) for frames in pair]
        assert 1.5 < steps[0] / steps[1] < 2.2


def test_the_middle_moves_by_two_thirds_of_the_speed_and_turn_and_zoom_stay():
    """Speeds of 1000 motions: of the middle, and of points all over a frame of 3:2 at rest."""
    moments, rng = [], np.random.default_rng(0)
    for key in range(1000):
        motion, time_s = SimilarityMotion(np.random.default_rng(key), (1.0, 1.0)), rng.uniform(0, 2)
        states = [motion.shift_angle_log_zoom(t) for t in (time_s, time_s + 1e-5)]
        moments.append([(b - a) / 1e-5 for a, b in zip(*states, strict=True)])
    shifts, turns, zooms = map(np.array, zip(*moments, strict=True))
    assert np.hypot(*shifts.T).mean() == pytest.approx(0.67, abs=0.02)
    places = np.hypot(*rng.uniform([[-0.5], [-1 / 3]], [[0.5], [1 / 3]], (2, len(turns))))
    assert (np.hypot(turns, zooms) * places).mean() == pytest.approx(0.09, abs=0.01)


def test_resolution_shows_the_same_scene():
    low = Photographs(frames=2, height=64, width=64, max_cutouts=0).clip(1).frames[0]
    high = Photographs(frames=2, height=192, width=192, max_cutouts=0).clip(1).frames[0]
    shrunk = cv2.resize(high.numpy(), (64, 64), interpolation=cv2.INTER_AREA)
    assert np.corrcoef(low.numpy().ravel(), shrunk.ravel())[0, 1] > 0.97


def test_splits_are_disjoint_embedded_and_in_a_folder(tmp_path):
    for number in range(23):
        cv2.imwrite(str(tmp_path / f"{number:03}.png"), np.full((32, 32), number, np.uint8))
    for root in (None, str(tmp_path)):
        parts = [set(list_photographs(root, split)) for split in ("train", "val", "test")]
        assert all(parts) and sum(map(len, parts)) == len(set.union(*parts))
        assert len(parts[0]) > len(parts[2]) >= len(parts[1])
    names = " ".join(EMBEDDED.values()).split()
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"root": "/nowhere"}, "scene.root"),
        ({"height": 4}, "scene.height"),
        ({"frames": 1}, "scene.frames"),
        ({"fps": 0.0}, "fps"),
        ({"speed_widths_per_s": (2.0, 1.0)}, "scene.speed_widths_per_s"),
        ({"photo_px_per_px": (0.0, 1.0)}, "scene.photo_px_per_px"),
        ({"cutout_widths": (0.3, 0.1)}, "scene.cutout_widths must be a range 0.001 < low <= hi"),
        ({"cutout_widths": (0.1, float("nan"))}, "scene.cutout_widths must be a range"),
        ({"static_camera_share": -0.1}, r"scene.static_camera_share must be in \[0, 1\]"),
        ({"paused_clip_share": 1.1}, r"scene.paused_clip_share must be in \[0, 1\]"),
        ({"paused_clip_share": float("nan")}, r"scene.paused_clip_share must be in \[0, 1\]"),
        ({"max_cutouts": -1}, "scene.max_cutouts"),
        ({"max_cutouts": 10**11}, r"scene.max_cutouts must be in \[0, 100\], got 100000000000"),
        ({"height": 10**11}, r"scene.height must be in \[8, 16384\], got 100000000000"),
        ({"photo_px_per_px": [1e30, 1e30]}, "photo_px_per_px must be a range 0 < low <= high <= 1"),
        ({"speed_widths_per_s": [1e30, 1e30]}, "scene.speed_widths_per_s must be a range 0 < lo"),
        ({"cutout_widths": [1e-9, 0.1]}, "scene.cutout_widths must be a range 0.001 < low <= hi"),
        ({"split": "exam"}, "split"),
    ],
)
def test_wrong_values_name_their_key(wrong, key):
    with pytest.raises(ValueError, match=key):
        Photographs(**wrong)


@dataclass(kw_only=True, eq=False)
class AnyScene(SceneBase):
    """A scene that takes values of any type, as a config may give."""

    max_cutouts: Any = 3
    speed_widths_per_s: Any = (0.1, 1.5)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"max_cutouts": float("inf")}, r"scene.max_cutouts must be in \[0, 100\], got inf"),
        ({"max_cutouts": [1, 2]}, r"scene.max_cutouts must be in \[0, 100\], got \[1, 2\]"),
        ({"max_cutouts": 2.5}, "scene.max_cutouts must be a whole number, got 2.5"),
        ({"speed_widths_per_s": 3}, "scene.speed_widths_per_s must be a range .*, got 3"),
        ({"speed_widths_per_s": None}, "scene.speed_widths_per_s must be a range .*, got None"),
    ],
)
def test_values_of_another_type_name_their_key(wrong, message):
    with pytest.raises(ValueError, match=message):
        AnyScene(**wrong)


def test_empty_folder_and_unreadable_photographs(tmp_path):
    with pytest.raises(ValueError, match="scene.root must hold at least 10"):
        Photographs(str(tmp_path))
    for number in range(10):
        (tmp_path / f"{number}.jpg").write_bytes(b"not a picture")
    with pytest.raises(ValueError, match="scene.root must hold readable"):
        Photographs(str(tmp_path)).clip(0)


def test_mixed_rates_draw_the_rate_of_a_clip_from_its_number():
    scenes = [Photographs(height=32, width=32, frames=2, fps=fps) for fps in (60.0, 600.0)]
    mixed = FrameRateMixture(scenes)
    rates = [mixed.clip(index).fps for index in range(12)]
    assert set(rates) == {60.0, 600.0} and rates == [mixed.clip(i).fps for i in range(12)]
    for other in (FrameRateMixture(scenes, seed=1), FrameRateMixture(scenes, "val")):
        assert rates != [other.clip(i).fps for i in range(12)]


GREYS = {  # of frame 8, every 80 pixels from (40, 40) on, of clips 0 to 2: as in version 0.2
    "default": [
        [0.2359, 0.7407, 0.4567, 0.1992, 0.1962, 0.1013, 0.2585, 0.0434, 0.0404],
        [0.4250, 0.5735, 0.4563, 0.7178, 0.4322, 0.6166, 0.4276, 0.6250, 0.4595],
        [0.2657, 0.4342, 0.6455, 0.5555, 0.6818, 0.4408, 0.3988, 0.7089, 0.4755],
    ],
    "still": [
        [0.3324, 0.4711, 0.5581, 0.2947, 0.1408, 0.1683, 0.2838, 0.1268, 0.4146],
        [0.4239, 0.4280, 0.4369, 0.4331, 0.4309, 0.4385, 0.4262, 0.4343, 0.4298],
        [0.2570, 0.4337, 0.6530, 0.3850, 0.6315, 0.5513, 0.4526, 0.5589, 0.5396],
    ],
}


@pytest.mark.parametrize("kind", GREYS)
def test_clips_are_those_that_published_numbers_are_of(kind):
    still = {"static_camera_share": 1.0, "paused_clip_share": 1.0, "max_cutouts": 4}
    scene = Photographs(frames=9, **(still if kind == "still" else {}))
    for index, greys in enumerate(GREYS[kind]):
        frame = scene.clip(index).frames[-1, 40::80, 40::80]
        assert torch.allclose(frame.flatten(), torch.tensor(greys), atol=2e-3)


def folder(path, count):
    path.mkdir()
    for number in range(count):
        cv2.imwrite(str(path / f"{number:03}.png"), np.full((32, 32), number, np.uint8))
    return str(path)


def test_more_photographs_serve_training_only(tmp_path):
    root, more, third = (folder(tmp_path / name, 12) for name in ("b", "a", "c"))
    for split in ("train", "val", "test"):
        plain = Photographs(root, split=split, frames=2)
        both = Photographs(root, split=split, frames=2, extra_train_root=[more, third])
        extra = both.photos[len(plain.photos) :]
        assert both.photos[: len(plain.photos)] == plain.photos
        assert len(extra) == (24 if split == "train" else 0)
        if split != "train":
            assert torch.equal(plain.clip(0).frames, both.clip(0).frames)
    assert len(Photographs(None, extra_train_root=more).photos) == 9 + 12


def test_photographs_that_validation_or_test_have_are_not_trained_on(tmp_path):
    inner = folder(tmp_path / "b", 12)
    for roots in ([inner, inner], [str(tmp_path), inner], [inner, str(tmp_path)]):
        with pytest.raises(ValueError, match="scene.root must be folders apart"):
            Photographs(roots)
    for root, more in ((inner, inner), (str(tmp_path), inner), (inner, [str(tmp_path)])):
        with pytest.raises(ValueError, match="extra_train_root must be apart from scene.root"):
            Photographs(root, extra_train_root=more)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="extra_train_root must hold photographs, got none in"):
        Photographs(inner, extra_train_root=str(tmp_path / "empty"))
    with pytest.raises(ValueError, match="scene.extra_train_root must be a folder or a pack"):
        Photographs(inner, extra_train_root="/nowhere")
