"""Targets: drawn where their truth says, by any part of a pixel, as functions of time."""

import math

import numpy as np
import pytest
import torch

from src.figures.slices import circle_points, sample_points
from src.sim.scenes.targets import (
    TARGETS,
    Targets,
    antialiased_square_wave,
    disc_coverage,
    edge_coverage,
    to_body_coordinates,
)

SMALL = {"height": 64, "width": 80, "frames": 13, "split": "test"}


def target(kind: str, options: dict | None = None, **arguments) -> Targets:
    """Return the scene of one kind."""
    return Targets(kinds=[kind], options={kind: options or {}}, **arguments)


def centroid(frames: torch.Tensor) -> np.ndarray:
    """Return the centre (x, y) of what is brighter than the ground."""
    light = frames.double().numpy() - float(frames.min())
    y, x = np.mgrid[: light.shape[1], : light.shape[2]]
    moments = [(light * axis).sum((1, 2)) / light.sum((1, 2)) for axis in (x, y)]
    return np.stack(moments, 1)


@pytest.mark.parametrize("kind", TARGETS)
def test_grey_levels_follow_the_contrast(kind):
    clip = target(kind, **SMALL, contrast=0.4).clip(0)
    assert clip.frames.shape == (13, 64, 80) and clip.frames.dtype == torch.float32
    assert math.isclose(float(clip.frames.min()), 0.3, abs_tol=1e-6)
    assert 0.6 < float(clip.frames.max()) <= 0.7 + 1e-6


def test_a_dot_is_where_its_truth_says_and_circles():
    clip = target("rotating_dot", {"turns_per_s": 3.0}, **SMALL).clip(0)
    assert np.abs(centroid(clip.frames) - clip.path_px.numpy()).max() < 0.03
    away = clip.path_px.numpy() - (39.5, 31.5)
    assert np.allclose(np.linalg.norm(away, axis=1), 0.3 * 64, atol=1e-4)
    angle = np.unwrap(np.arctan2(away[:, 1], away[:, 0]))
    assert np.allclose(np.diff(angle), 2 * math.pi * 3.0 / 120, atol=1e-5)


def test_a_stripe_draws_straight_lines_in_theta_and_time():
    clip = target("spinning_stripe", {"turns_per_s": 2.0}, height=96, width=96, frames=25).clip(1)
    slices = sample_points(clip.frames.numpy(), circle_points((47.5, 47.5), 30, 720))
    # The stripe crosses the circle at two opposite angles: the second harmonic turns twice as far.
    phase = np.unwrap(np.angle(np.fft.rfft(slices)[:, 2])) / -2
    assert np.allclose(np.diff(phase), 2 * math.pi * 2.0 / 120, atol=0.003)
    end = clip.path_px.numpy() - 47.5
    off = np.unwrap(np.arctan2(end[:, 1], end[:, 0]) - phase, period=math.pi)
    assert off.std() < 0.003


def test_a_checkerboard_has_its_corner_on_the_truth():
    scene = target("checkerboard", {"squares": 4, "speed_px_per_s": 300.0}, **SMALL)
    for index in range(3):
        clip = scene.clip(index)
        for frame, (x, y) in zip(clip.frames.numpy(), clip.path_px.tolist(), strict=True):
            if not (4 < x < 75 and 4 < y < 59):
                continue
            points = np.array([[x - 3, y - 3], [x + 3, y - 3], [x - 3, y + 3], [x + 3, y + 3]])
            values = sample_points(frame[None], points)[0]
            assert np.allclose(values, [0.9, 0.1, 0.1, 0.9], atol=0.01)
    steps = np.linalg.norm(np.diff(clip.path_px.numpy(), axis=0), axis=1)
    assert np.allclose(steps, 300 / 120, atol=1e-4)


def test_a_still_checkerboard_stands_still():
    frames = target("checkerboard", **SMALL).clip(0).frames
    assert torch.equal(frames[1:], frames[:-1])


def test_a_dart_flies_straight_at_the_speed_of_the_paper():
    paper = {"speed_px_per_s": 16_000.0}
    clip = target("dart", paper, height=256, width=256, frames=101, fps=12_000.0).clip(2)
    steps = np.diff(clip.path_px.numpy(), axis=0)
    assert np.allclose(np.linalg.norm(steps, axis=1), 16_000 / 12_000, atol=1e-3)
    assert np.allclose(steps, steps[0], atol=1e-3)
    seen = clip.frames.amax((1, 2)) > 0.5
    whole = ((clip.path_px > 40) & (clip.path_px < 215)).all(1)
    assert seen[whole].all() and whole.sum() > 20
    off = centroid(clip.frames[whole]) - clip.path_px[whole].numpy()
    across = off @ np.array([-steps[0, 1], steps[0, 0]]) / np.linalg.norm(steps[0])
    assert np.abs(across).max() < 0.02


@pytest.mark.parametrize("index", range(4))
def test_a_dart_turns_up_and_leaves_out_of_sight(index):
    clip = target("dart", {"speed_px_per_s": 700.0}, **SMALL | {"frames": 400}).clip(index)
    jumps = (clip.path_px[1:] - clip.path_px[:-1]).norm(dim=1) > 700 / 120 + 1
    assert jumps.any()
    dark = (clip.frames == clip.frames.min()).all(2).all(1)
    assert (dark[1:] & dark[:-1])[jumps].all()


def test_a_ball_stays_inside_falls_and_keeps_its_texture():
    clip = target("bouncing_ball", height=100, width=140, frames=241).clip(0)
    x, y = clip.path_px.T.numpy()
    radius = 12
    assert x.min() >= radius and x.max() <= 139 - radius
    assert y.max() <= 99 - radius + 1e-3 and np.ptp(y) > 55
    bend = np.diff(y, 2) * 120**2
    assert np.isclose(np.median(bend), 8 * 60, rtol=0.02)  # 8 rise bounces^2, downwards
    across, down = np.arange(140), np.arange(100)[:, None]
    ball = np.stack([disc_coverage(across - a, down - b, 9) for a, b in zip(x, y, strict=True)])
    assert (clip.frames.numpy()[ball == 1] < 0.5).mean() > 0.3


def test_dots_stand_in_their_grid():
    clip = target("dot_grid", {"dots": 3, "dot_radius": 0.1}, height=90, width=90, frames=2).clip(0)
    assert np.allclose(centroid(clip.frames), clip.path_px.numpy(), atol=0.01)
    x, y = clip.path_px[0].tolist()
    points = np.array([[x + dx, y + dy] for dx in (-30, -15, 0, 15, 30) for dy in (-30, 0, 30)])
    expected = np.repeat([0.9, 0.1, 0.9, 0.1, 0.9], 3)
    assert np.allclose(sample_points(clip.frames.numpy(), points)[0], expected, atol=1e-4)


def test_targets_cycle_over_kinds_and_pass_options():
    scene = Targets(kinds=["dart", "dot_grid"], options={"dot_grid": {"dots": 1}}, **SMALL)
    assert [scene.clip(index).name for index in range(3)] == ["Dart-0", "DotGrid-0", "Dart-1"]
    alone = target("dot_grid", {"dots": 1}, **SMALL)
    assert torch.equal(scene.clip(3).frames, alone.clip(1).frames)


@pytest.mark.parametrize("kinds, options", [([], {}), (["darts"], {}), (["dart"], {"dot": {}})])
def test_unknown_kinds_are_refused(kinds, options):
    with pytest.raises(ValueError, match="scene.kinds must be some of checkerboard"):
        Targets(kinds=kinds, options=options)


@pytest.mark.parametrize(
    "make, message",
    [
        (
            lambda: target("dart", {"speed_px_per_s": 1e6}),
            "scene.options.dart.speed_px_per_s must be in",
        ),
        (
            lambda: target("dart", {"speed_px_per_s": math.nan}),
            "scene.options.dart.speed_px_per_s must be in",
        ),
        (
            lambda: target("rotating_dot", {"dot_radius": 0.0}),
            "scene.options.rotating_dot.dot_radius must be in",
        ),
        (
            lambda: target("checkerboard", {"squares": 0}),
            "scene.options.checkerboard.squares must be in",
        ),
        (
            lambda: target("bouncing_ball", {"bounce_height": 0.9}),
            "scene.options.bouncing_ball.bounce_height must be in",
        ),
        (lambda: target("dot_grid", contrast=1.5), "scene.contrast must be in"),
        (
            lambda: target("dart", {"dots": 1}),
            "scene.options.dart must hold dart_length, dart_width",
        ),
        (lambda: target("dot_grid", split="all"), "split must be one of"),
    ],
)
def test_impossible_targets_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_shapes_cover_what_a_fine_grid_says():
    """Against 32 x 32 samples per pixel."""
    fine = (np.arange(32) + 0.5) / 32 - 0.5
    at = (np.arange(24)[:, None] + fine).ravel()
    x, y = np.meshgrid(at, at)
    pixel_x, pixel_y = np.meshgrid(np.arange(24.0), np.arange(24.0))

    def mean(samples):
        return samples.reshape(24, 32, 24, 32).mean((1, 3))

    exact = mean(np.hypot(x - 11.3, y - 12.1) < 5.4)
    assert np.abs(disc_coverage(pixel_x - 11.3, pixel_y - 12.1, 5.4) - exact).max() < 0.06
    assert abs(exact.sum() / disc_coverage(pixel_x - 11.3, pixel_y - 12.1, 5.4).sum() - 1) < 0.004
    exact = mean(np.where((x - 3.3) % 10 < 5, 1.0, -1.0))
    # 0.07: the fine grid's own step
    assert np.abs(antialiased_square_wave(pixel_x - 3.3, 5.0) - exact).max() < 0.07
    along, _ = to_body_coordinates(x - 9.2, y - 9.7, 0.6)
    exact = mean(along < 4.0)
    along, _ = to_body_coordinates(pixel_x - 9.2, pixel_y - 9.7, 0.6)
    assert np.abs(edge_coverage(4.0 - along) - exact).max() < 0.06
