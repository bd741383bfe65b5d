"""Slices of videos that are known in closed form."""

import math

import numpy as np
import pytest
from PIL import Image

from src.figures.comparison import VideoRow, draw_comparison, find_slice_ends
from src.figures.slices import (
    circle_points,
    line_points,
    name_axis,
    rotating_ray_xy,
    sample_points,
    shrink_to_smallest,
)

Y, X = np.mgrid[:40, :60].astype(float)


def test_a_plane_is_sampled_exactly_between_pixels():
    video = np.stack([X + 2 * Y, 100 + X])
    points = np.array([[3.25, 7.5], [10.0, 20.0], [0.0, 38.5]])
    expected = np.stack([points @ (1, 2), 100 + points[:, 0]])
    assert np.allclose(sample_points(video, points), expected, atol=0.05)


def test_row_and_column_are_the_video_itself():
    video = np.random.default_rng(0).random((5, 40, 60)).astype(np.float32)
    assert np.allclose(
        sample_points(video, line_points((0, 12), (59, 12))), video[:, 12], atol=1e-6
    )
    assert np.allclose(
        sample_points(video, line_points((7, 0), (7, 39))), video[:, :, 7], atol=1e-6
    )


def test_a_turning_sector_draws_a_straight_line_of_its_own_speed():
    turn = 2 * math.pi * np.arange(12) / 24
    angle = np.arctan2(Y - 20, X - 30)
    video = np.stack([np.cos(angle - phase) for phase in turn])
    slices = sample_points(video, circle_points((30, 20), 15, 240))
    assert np.array_equal(slices.argmax(1) // 10, np.arange(12))
    assert np.abs(slices.argmax(1) - 10 * np.arange(12)).max() <= 2


def test_a_circling_dot_stays_at_its_radius():
    angles = np.linspace(0, 5, 20)
    spots = 12 * np.stack([np.cos(angles), np.sin(angles)], 1) + (30, 20)
    video = np.stack([np.exp(-((X - x) ** 2 + (Y - y) ** 2) / 8) for x, y in spots])
    radii = np.linspace(0, 18, 73)
    slices = sample_points(video, rotating_ray_xy((30, 20), angles, radii))
    middle = (slices * radii).sum(1) / slices.sum(1)
    assert np.abs(middle - 12).max() < 0.1


def test_points_are_at_most_a_pixel_apart():
    for points in (line_points((2, 3), (30.5, 17.2)), circle_points((20, 20), 9.3)):
        assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() <= 1


def test_outside_is_refused():
    with pytest.raises(ValueError, match=r"60x40 px, got \(70.0, 3.0\)"):
        sample_points(np.zeros((2, 40, 60)), np.array([[5.0, 3.0], [70.0, 3.0]]))


@pytest.mark.parametrize(
    ("kind", "points", "axis"),
    [
        ("line", line_points((0, 12), (59, 12)), "x"),
        ("still", line_points((0, 12), (59, 12)), "x"),
        ("line", line_points((7, 0), (7, 39)), "y"),
        ("line", line_points((30, 20), (50, 30)), "r"),
        ("circle", circle_points((30, 20), 15), "theta"),
        ("spin", rotating_ray_xy((30, 20), np.zeros(1), np.arange(9.0))[0], "r"),
    ],
)
def test_a_slice_is_named_by_its_coordinate(kind, points, axis):
    assert name_axis(kind, points) == axis


def test_the_smallest_video_is_that_of_the_fewest_pixels_and_rounded_sides_are_one_shape():
    videos = {name: np.ones((2, *size)) for name, size in (("a", (720, 1280)), ("b", (176, 313)))}
    assert [video.shape for video in shrink_to_smallest(videos).values()] == [(2, 176, 313)] * 2
    with pytest.raises(ValueError, match="a 720x1280 and b 176x310"):
        shrink_to_smallest(videos | {"b": np.ones((2, 176, 310))})


@pytest.mark.parametrize("note", ["", "SSIM 0.5"])
def test_a_comparison_ends_with_its_slices_or_with_notes_where_there_are_some(tmp_path, note):
    video = np.zeros((6, 40, 40))
    rows = [VideoRow(name, video, video[:, 20], note) for name in ("a", "b")]
    draw_comparison(
        rows, tmp_path / "a.png", line=np.array([[0.0, 20.0], [39.0, 20.0]]), frame_s=0.02
    )
    shown = np.asarray(Image.open(tmp_path / "a.png").convert("L")) < 100
    end = np.flatnonzero(shown[shown.shape[0] // 4]).max() / shown.shape[1]
    assert end < 0.9 if note else end > 0.97


def test_times_and_places_of_a_comparison_are_those_of_the_frames(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "src.figures.comparison.save_figure", lambda figure, _: drawn.append(figure)
    )
    video = np.zeros((3, 100, 160))
    points = line_points((40, 64), (120, 64))
    rows = [VideoRow("a", video, video[:, 64, 40:121])]
    draw_comparison(rows, tmp_path / "a.png", line=points, frame_s=1 / 120, samples=2)
    first, last, slice_panel = drawn[0].axes
    assert [first.get_title(), last.get_title()] == ["0.0 ms", "16.7 ms"]
    assert slice_panel.get_title() == "x-t, 25 ms"
    assert slice_panel.images[0].get_extent() == pytest.approx([39.5, 120.5, 25, 0])
    assert (slice_panel.get_xlabel(), slice_panel.get_ylabel()) == ("x, px", "t, ms")
    later = {"frame_s": 1 / 120, "start_s": 0.1, "samples": 2}
    draw_comparison(rows, tmp_path / "a.png", line=points, **later)
    first, last, slice_panel = drawn[1].axes
    assert [first.get_title(), last.get_title()] == ["100.0 ms", "116.7 ms"]
    assert slice_panel.images[0].get_extent() == pytest.approx([39.5, 120.5, 125, 100])


@pytest.mark.parametrize(
    ("axis", "line", "ends"),
    [
        ("x", line_points((0, 12), (59, 12)), (-0.5, 59.5)),
        ("x", line_points((59, 12), (0, 12)), (59.5, -0.5)),
        ("y", line_points((7, 10), (7, 30)), (9.5, 30.5)),
        ("r", line_points((10, 20), (40, 60)), (-0.5, 50.5)),
        ("theta", circle_points((30, 20), 15, 90), (-2, 358)),
    ],
)
def test_a_slice_begins_and_ends_half_a_place_beyond_its_points(axis, line, ends):
    assert find_slice_ends(axis, line, len(line)) == pytest.approx(ends)
