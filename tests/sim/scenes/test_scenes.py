"""Photographs in motion: reproducible, smooth, a function of time, disjoint splits."""

import cv2
import numpy as np
import pytest
import torch

from src.sim.scenes.photographs import EMBEDDED, MixedRates, Photographs, photographs


def test_a_clip_is_a_function_of_seed_split_and_index():
    first, again = Photographs(frames=3).clip(4), Photographs(frames=3).clip(4)
    assert torch.equal(first.frames, again.frames) and first.name == again.name
    others = [
        Photographs(frames=3).clip(5),
        Photographs(frames=3, seed=1).clip(4),
        Photographs(frames=3, split="test").clip(4),
    ]
    assert all(not torch.equal(first.frames, other.frames) for other in others)


def test_frames_are_code_values():
    clip = Photographs(frames=4, height=64, width=96).clip(0)
    assert clip.frames.shape == (4, 64, 96) and clip.frames.dtype == torch.float32
    assert 0 <= float(clip.frames.min()) < float(clip.frames.max()) <= 1
    assert clip.fps == 120.0


def test_a_finer_clip_holds_the_coarse_one():
    coarse = Photographs(frames=4, fps=120.0).clip(2).frames
    fine = Photographs(frames=10, fps=360.0).clip(2).frames
    assert torch.equal(coarse, fine[::3])


def test_motion_is_smooth_and_of_the_stated_speed():
    """Halving the frame interval halves the change from frame to frame: nothing jumps."""
    slow = Photographs(frames=9, fps=120.0, speed=(0.5, 0.5), cutouts=0)
    fast = Photographs(frames=9, fps=240.0, speed=(0.5, 0.5), cutouts=0)
    for index in range(4):
        steps = [
            float((clip.frames[1:] - clip.frames[:-1]).abs().mean())
            for clip in (slow.clip(index), fast.clip(index))
        ]
        assert 1.5 < steps[0] / steps[1] < 2.2


def test_resolution_shows_the_same_scene():
    low = Photographs(frames=2, height=64, width=64, cutouts=0).clip(1).frames[0]
    high = Photographs(frames=2, height=192, width=192, cutouts=0).clip(1).frames[0]
    shrunk = cv2.resize(high.numpy(), (64, 64), interpolation=cv2.INTER_AREA)
    assert np.corrcoef(low.numpy().ravel(), shrunk.ravel())[0, 1] > 0.97


def test_splits_are_disjoint_embedded_and_in_a_folder(tmp_path):
    for number in range(23):
        cv2.imwrite(str(tmp_path / f"{number:03}.png"), np.full((32, 32), number, np.uint8))
    for root in (None, str(tmp_path)):
        parts = [set(photographs(root, split)) for split in ("train", "val", "test")]
        assert all(parts) and sum(map(len, parts)) == len(set.union(*parts))
        assert len(parts[0]) > len(parts[2]) >= len(parts[1])
    assert len(set(" ".join(EMBEDDED.values()).split())) == sum(
        len(names.split()) for names in EMBEDDED.values()
    )


@pytest.mark.parametrize(
    ("wrong", "key"),
    [
        ({"root": "/nowhere"}, "scene.root"),
        ({"height": 4}, "scene.height"),
        ({"frames": 1}, "scene.frames"),
        ({"fps": 0.0}, "fps"),
        ({"speed": (2.0, 1.0)}, "scene.speed"),
        ({"zoom": (0.0, 1.0)}, "scene.zoom"),
        ({"cutouts": -1}, "scene.cutouts"),
        ({"split": "exam"}, "split"),
    ],
)
def test_wrong_values_name_their_key(wrong, key):
    with pytest.raises(ValueError, match=key):
        Photographs(**wrong)


def test_empty_folder_and_unreadable_photographs(tmp_path):
    with pytest.raises(ValueError, match="scene.root must hold at least 10"):
        Photographs(str(tmp_path))
    for number in range(10):
        (tmp_path / f"{number}.jpg").write_bytes(b"not a picture")
    with pytest.raises(ValueError, match="scene.root must hold readable"):
        Photographs(str(tmp_path)).clip(0)


def test_mixed_rates_draw_the_rate_of_a_clip_from_its_number():
    scenes = [Photographs(height=32, width=32, frames=2, fps=fps) for fps in (60.0, 600.0)]
    mixed = MixedRates(scenes)
    rates = [mixed.clip(index).fps for index in range(12)]
    assert set(rates) == {60.0, 600.0} and rates == [mixed.clip(i).fps for i in range(12)]
