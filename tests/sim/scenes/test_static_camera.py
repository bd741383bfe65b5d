"""A camera that stands still: small things before it, targets before photographs, its config."""

import numpy as np
import pytest
import torch

from src.app.instantiate import build_part, instantiate_node
from src.sim.scenes.moving_layers import MovingLayer, SimilarityMotion, render_frame
from src.sim.scenes.photographs import Photographs
from src.sim.scenes.targets import TARGETS, Targets, sector_coverage
from src.sim.scenes.targets_on_photographs import TargetsOnPhotographs
from tests.test_train import config

FRAME = {"height": 64, "width": 80, "frames": 5, "fps": 120.0}
SMALL = {
    "static_camera_share": 1.0, "max_cutouts": 6, "cutout_widths": (0.05, 0.2),
    "cutouts_reenter": True,
}  # fmt: skip
ALL = {
    "bouncing_ball": {
        "ball_radius": [0.05, 0.12],
        "bounce_height": [0.2, 0.6],
        "speed_widths_per_s": [0.1, 2],
    },
    "dart": {"dart_length": [0.2, 0.35], "dart_width": [0.03, 0.1], "speed_px_per_s": [300, 6000]},
    "rotating_dot": {"orbit_radius": 0.3, "dot_radius": 0.06, "turns_per_s": [-4, 4]},
    "spinning_stripe": {"stripe_length": [0.3, 0.7], "stripe_width": 0.1, "turns_per_s": [0.3, 4]},
    "spinning_disc": {"disc_radius": [0.1, 0.25], "sectors": [1, 6], "turns_per_s": [0.3, 4]},
    "dot_grid": {"dots": [1, 3], "dot_radius": 0.05},
}


def moved(frames: torch.Tensor) -> float:
    """Return the share of the pixels that ever change."""
    return float((frames != frames[0]).any(0).float().mean())


@pytest.mark.parametrize(
    "scene", [Photographs(**FRAME, **SMALL), TargetsOnPhotographs(kinds=ALL, **FRAME)]
)
def test_only_small_things_move(scene):
    shares = [moved(scene.clip(index).frames) for index in range(12)]
    assert max(shares) < 0.5 and sum(share > 0 for share in shares) > 7


def test_small_cut_outs_take_the_room_that_their_sizes_say():
    """What turns about its own middle changes its own room only: a disc of 0.92 of its side."""
    frame = {"height": 120, "width": 120, "frames": 9, "fps": 30.0}
    slow = {"speed_widths_per_s": (1e-9, 1e-9), "static_camera_share": 1.0}
    spans = []
    for index in range(12):
        sizes = {"max_cutouts": 1, "cutout_widths": (0.1, 0.1), "cutouts_reenter": True}
        frames = Photographs(**frame, **sizes, **slow).clip(index).frames
        places = torch.nonzero((frames != frames[0]).any(0))
        spans += [int(np.ptp(axis)) + 1 for axis in places.T.numpy() if len(axis)]
    assert len(spans) == 24 and max(spans) <= 0.92 * 12 * 1.2 + 2 and np.median(spans) > 6


def speck(speed: float) -> MovingLayer:
    """Return a white disc in a square of 16 px that starts in the middle and drifts."""
    motion = SimilarityMotion(np.random.default_rng(3), (speed, speed))
    motion.stop()
    motion.drift, motion.angle = np.array([0.6, 0.2]) * speed, 0.3
    white = np.ones((16, 16), np.float32)
    mask = np.hypot(*np.mgrid[-7.5:8, -7.5:8]) < 0.92 * 8
    return MovingLayer(white, mask.astype(np.float32), np.array([8.0, 8.0]), 1.0, motion, True)


def test_a_cut_out_that_left_comes_in_again_on_the_other_side():
    layer, size = speck(1.0), (64, 96)
    black, middle = np.zeros((64, 96), np.float32), np.array([48.0, 32.0])
    ground = MovingLayer(black, None, middle, 1.0, speck(1e-9).motion, True)
    times = np.arange(0, 12, 0.01)
    frames = np.stack([render_frame([ground, layer], time, size) for time in times])
    seen = frames.sum((1, 2))
    y, x = np.mgrid[:64, :96]
    first = frames[0]
    assert abs((first * x).sum() / seen[0] - 47.5) < 0.75
    assert abs((first * y).sum() / seen[0] - 31.5) < 0.75
    assert 0 < (seen == 0).mean() < 0.5
    across = (frames * x).sum((1, 2))[seen > 20] / seen[seen > 20]
    assert abs(np.diff(across)).max() > 60  # out on one side, in on the other
    steps = abs(np.diff(frames, axis=0)).sum((1, 2))
    assert steps.max() < 40  # 0.6 px of a disc 15 px wide: it never appears or vanishes at once


def test_targets_are_drawn_before_the_photograph_and_only_there():
    kinds = {"rotating_dot": {"orbit_radius": 0.0, "dot_radius": 0.1, "turns_per_s": 0.0}}
    scene = TargetsOnPhotographs(kinds=kinds, **FRAME, max_targets=1)
    small = {"rotating_dot": {"dot_radius": 1 / 64}}
    other = TargetsOnPhotographs(kinds=small, **FRAME, max_targets=1)
    for index in range(4):
        frame, bare = scene.clip(index).frames[0], other.clip(index).frames[0]
        differ = (frame - bare).abs() > 1e-6
        assert 40 < int(differ.sum()) < 3.15 * (6.4 + 2.5) ** 2  # the dot, and the other's own
        levels = frame[differ].unique(return_counts=True)[1]
        assert int(levels.max()) > 0.5 * int(differ.sum())  # of one grey level


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"kinds": {}}, "scene.kinds must be some of rotating_dot"),
        ({"kinds": {"checkerboard": {}}}, "scene.kinds must be some of rotating_dot.*checkerboard"),
        ({"kinds": {"dart": {"dart_width": [5, 1]}}}, "kinds.dart.dart_width must be a number or"),
        ({"kinds": {"dart": {"dart_width": "a"}}}, "kinds.dart.dart_width must be .*got a"),
        (
            {"kinds": {"dart": {"speed_px_per_s": [1, 1e6]}}},
            r"scene.kinds.dart.speed_px_per_s must be in \[0, 2",
        ),
        (
            {"kinds": {"bouncing_ball": {"ball_radius": 0.03}}},
            r"ball_radius must be in .* got 0.03, in frames of 80x64 px \(scene.width",
        ),
        ({"max_targets": 0}, r"scene.max_targets must be in \[1, 100\], got 0"),
        ({"paused_clip_share": 1.5}, r"scene.paused_clip_share must be in \[0, 1\], got 1.5"),
        ({"photo_px_per_px": [0, 1]}, "scene.photo_px_per_px must be a range"),
        ({"root": "/nowhere"}, "scene.root must be a folder or a pack"),
    ],
)
def test_wrong_values_name_their_key(wrong, message):
    with pytest.raises(ValueError, match=message):
        TargetsOnPhotographs(**{"kinds": ALL} | FRAME | wrong)


def test_sectors_cover_what_a_fine_grid_says():
    """Against 16 x 16 samples per pixel, off the middle."""
    fine = (np.arange(16) + 0.5) / 16 - 0.5
    at = (np.arange(32)[:, None] + fine).ravel() - 15.3
    x, y = np.meshgrid(at, at)
    pixel_x, pixel_y = np.meshgrid(np.arange(32) - 15.3, np.arange(32) - 15.3)
    for number in (1, 2, 3, 6):
        exact = np.arctan2(y, x) % (2 * np.pi / number) < np.pi / number
        exact = exact.reshape(32, 16, 32, 16).mean((1, 3))
        off = abs(sector_coverage(pixel_x, pixel_y, number) - exact)
        assert off[np.hypot(pixel_x, pixel_y) > max(1, number)].max() < 0.08


def test_a_disc_turns_about_its_middle_by_its_speed():
    options = {"spinning_disc": {"sectors": 2, "disc_radius": 0.3, "turns_per_s": 5.0}}
    disc = Targets(kinds=list(options), options=options, height=65, width=65, frames=9)
    clip = disc.clip(0)
    turned = np.degrees(2 * np.pi * 5.0 / 120)
    assert turned == pytest.approx(15)
    torch.testing.assert_close(clip.frames[0], clip.frames[6].rot90(1), atol=0.02, rtol=0)
    away = clip.path_px - 32
    assert torch.allclose(away.norm(dim=1), torch.tensor(0.3 * 65), atol=1e-4)
    assert "spinning_disc" in TARGETS


def test_the_scenes_of_a_static_camera_need_no_data(tmp_path):
    sizes = ("scene.height=128", "scene.width=160", "sensor=any_camera")
    cfg = config("train", tmp_path, "scene=static_camera", *sizes)
    for split, parts in (("train", 6), ("val", 5), ("test", 5)):
        scene = instantiate_node(cfg.scene, split=split, seed=0, frames=2, fps=480.0)
        assert len(scene.scenes) == parts
        assert all(part.clip(0).frames.shape == (2, 128, 160) for part in scene.scenes)
        lit = [scene.clip(index).illumination is not None for index in range(60)]
        assert 1 < sum(lit) < 22
    assert cfg.scene.parts.photographs.scene.max_cutouts == 4  # as in scene=training


def test_any_camera_draws_wide_ranges_and_keeps_the_sensor_of_the_paper(tmp_path):
    sensor = build_part(config("train", tmp_path, "sensor=any_camera"), "sensor", seed=0)
    chips = [sensor.draw(key) for key in range(400)]
    drawn = [chip for chip in chips if chip.initial_reference_error > 0]
    papers = [chip for chip in chips if chip.initial_reference_error == 0]
    assert 270 < len(drawn) < 330  # 300 +- 8.7
    thresholds = np.array([chip.threshold for chip in drawn])
    assert 0.05 <= thresholds.min() < 0.07 and 1.2 < thresholds.max() <= 1.5
    assert 0.22 < np.median(thresholds) < 0.34  # log-uniform: sqrt(0.05 1.5) = 0.27
    assert min(chip.off_ratio for chip in drawn) < 0.7 < 1.4 < max(c.off_ratio for c in drawn)
    assert all(0.1 <= chip.threshold <= 0.7 and chip.dark_noise_hz == 0 for chip in papers)
    frames = torch.full((1, 1, 3, 8, 8), 0.5)
    assert all(chip.voxels(frames, 60.0).shape == (1, 1, 2, 5, 8, 8) for chip in chips[:40])
