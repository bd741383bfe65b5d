"""Scenes to train on: several kinds by share, still cameras, rests, several folders."""

from functools import partial

import cv2
import numpy as np
import pytest
import torch

from src.app.instantiate import instantiate_node
from src.sim.scenes.footage import Footage
from src.sim.scenes.mixture import Mixture
from src.sim.scenes.moving_layers import draw_motion_times_s
from src.sim.scenes.photo_files import list_photographs
from src.sim.scenes.photographs import Photographs
from src.sim.scenes.targets import Targets
from tests.test_train import config

FRAME = {"height": 32, "width": 32, "frames": 3, "fps": 120.0}
PHOTOS = partial(Photographs, max_cutouts=0)
DOTS = partial(Targets, kinds=["dot_grid"])


def mixture(photos: float, dots: float, split: str = "train", **more) -> Mixture:
    parts = {
        "photos": {"share": photos, "scene": PHOTOS},
        "dots": {"share": dots, "splits": ["train"], "scene": DOTS},
    }
    return Mixture(parts=parts, split=split, **FRAME | more)


def kinds(scene: Mixture, clips: int = 200) -> int:
    """Return how many clips show dots."""
    return sum(scene.clip(index).name.startswith("DotGrid") for index in range(clips))


def test_a_mixture_is_drawn_by_its_shares():
    assert 30 < kinds(mixture(3, 1)) < 72  # 50 +- 6.1
    assert kinds(mixture(1, 0)) == kinds(mixture(1, 1, split="val")) == 0
    assert kinds(mixture(0, 2), 20) == 20


@pytest.mark.parametrize(("split", "dots"), [("train", 0), ("val", 3), ("test", 3)])
def test_parts_in_turn_alternate_where_nothing_is_trained(split, dots):
    parts = {"photos": {"share": 1, "scene": PHOTOS}, "dots": {"share": 1e-6, "scene": DOTS}}
    scene = Mixture(parts=parts, split=split, in_turn=True, **FRAME)
    shown = [scene.clip(index).name.startswith("DotGrid") for index in range(6)]
    assert shown == [False, dots > 0] * 3


def test_a_clip_of_a_mixture_is_that_of_its_part_whatever_the_length():
    scene, longer = mixture(1, 1, seed=3), mixture(1, 1, seed=3, frames=5)
    parts = [part(split="train", seed=3, **FRAME) for part in (PHOTOS, DOTS)]
    for index in range(6):
        clip = scene.clip(index)
        assert any(torch.equal(clip.frames, part.clip(index).frames) for part in parts)
        assert torch.equal(longer.clip(index).frames[:3], clip.frames)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"a": {"share": -1, "scene": PHOTOS}}, "scene.parts.a.share must be >= 0, got -1"),
        ({"a": {"share": "x", "scene": PHOTOS}}, "scene.parts.a.share must be >= 0, got x"),
        ({"a": {"share": 0, "scene": PHOTOS}}, "scene.parts must have a share > 0 for split=train"),
        ({"a": {"share": 1, "splits": ["exam"], "scene": PHOTOS}}, "scene.parts.a.splits must be"),
        ({"a": {"share": 1, "scene": partial(Footage, root=None)}}, "^scene.video_root must be"),
        (
            {"a": {"share": 1, "scene": partial(DOTS, options={"dot_grid": {"dots": 0}})}},
            "^scene.parts.a.scene.options.dot_grid.dots must be",
        ),
        ({"a": {"share": 1, "scene": partial(PHOTOS, root="/none")}}, "^scene.root must be a fold"),
    ],
)
def test_wrong_parts_name_their_key(parts, message):
    with pytest.raises(ValueError, match=message):
        Mixture(parts=parts, **FRAME)


def test_the_scenes_to_train_on_need_no_data(tmp_path):
    cfg = config("train", tmp_path, "scene=training", "scene.height=64", "scene.width=64")
    for split in ("train", "val", "test"):
        scene = instantiate_node(cfg.scene, split=split, seed=0, frames=2, fps=120.0)
        assert scene.clip(0).frames.shape == (2, 64, 64)


def changes(scene: Photographs, index: int) -> torch.Tensor:
    """Return which pixels ever change, (h, w)."""
    frames = scene.clip(index).frames
    return (frames != frames[0]).any(0)


def test_a_still_camera_shows_moving_things_before_a_scene_that_stands():
    static = Photographs(frames=9, static_camera_share=1.0, max_cutouts=2)
    moving = [changes(static, index) for index in range(8)]
    shares = [float(where.float().mean()) for where in moving]
    assert max(shares) < 0.6 and sum(share > 0 for share in shares) > 4
    half = Photographs(frames=3, static_camera_share=0.5, max_cutouts=0)
    some = [changes(half, index).any() for index in range(40)]
    assert 10 < sum(map(bool, some)) < 30


def test_what_rests_is_the_same_clip_at_another_pace():
    times, counts = np.arange(240) / 240, {"pauses": 0, "stops": 0, "never": 0}
    for seed in range(60):
        moved = draw_motion_times_s(np.random.default_rng(seed), times)
        steps = np.diff(moved)
        assert moved[0] == 0 and steps.min() > -1e-9 and steps.max() < 1 / 240 + 1e-9
        ends = moved[-1] == moved[-84]  # rests last 0.3 s at most, this is 0.35 s
        counts["never" if moved[-1] == 0 else "stops" if ends else "pauses"] += 1
        assert (0.05 <= moved[-1] <= 0.3 or moved[-1] == 0) if ends else 0 < moved[-1] < 1
    assert all(8 < count < 32 for count in counts.values())  # 20 +- 3.7
    for index in range(6):
        moving, resting = (
            Photographs(**FRAME, paused_clip_share=s).clip(index).frames for s in (0.0, 1.0)
        )
        assert torch.equal(moving[0], resting[0])


def test_a_second_folder_leaves_the_splits_of_the_first_as_they_were(tmp_path):
    roots = [tmp_path / name for name in ("b", "a")]
    for number in range(46):
        root = roots[number % 2]
        root.mkdir(exist_ok=True)
        cv2.imwrite(str(root / f"{number:03}.png"), np.full((32, 32), number, np.uint8))
    for split in ("train", "val", "test"):
        both = list_photographs([str(root) for root in roots], split)
        assert both == [one for root in roots for one in list_photographs(str(root), split)]
    with pytest.raises(ValueError, match="scene.root must be a folder or a pack, or some, got an"):
        list_photographs([], "train")
    with pytest.raises(ValueError, match="scene.root must be a folder or a pack of.* got /nowhere"):
        list_photographs([str(roots[0]), "/nowhere"], "train")
