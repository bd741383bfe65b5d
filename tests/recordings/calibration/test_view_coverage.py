"""What a grid of views leaves out is said: events in no view, views that are blocked."""

import re
import warnings
from dataclasses import replace

import numpy as np
import pytest

from src.figures.calibration_figures import draw_views_over_centre
from src.recordings import simulated_recording
from src.recordings.calibration import scene_alignment, view_grid
from src.recordings.calibration.scene_matches import ViewMatches
from src.recordings.calibration.view_coverage import (
    leave_out_blocked_views,
    share_of_events_outside_views,
)
from src.sim.optics import layout
from tests.recordings.calibration.test_scene_alignment import texture

SIDE = 56


def fold_lines(sizes) -> np.ndarray:
    """Return the lines of a scene that three mirrored views of `sizes` show."""
    before, centre, after = map(np.arange, sizes)
    return 60 + np.concatenate([before[::-1], centre, sizes[1] - 1 - after])


def show_views(rows=(SIDE,) * 3, cols=(SIDE,) * 3, blocked=(), seeds=(3, 4)) -> np.ndarray:
    """Return pictures (2, 1, h, w) of views of these heights and widths."""
    whole = [200 * texture(seed)[np.ix_(fold_lines(rows), fold_lines(cols))] for seed in seeds]
    pictures = np.stack(whole)[:, None].astype(np.float32)
    for row, col in blocked:
        y, x = SIDE * (row + 1), SIDE * (col + 1)
        pictures[..., y : y + SIDE, x : x + SIDE] = 100  # as flat as events of noise alone
    return pictures


def test_whole_views_leave_nothing_out():
    pictures = show_views()
    grid = view_grid.find_grid(pictures)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert leave_out_blocked_views(grid, pictures) is grid
        assert share_of_events_outside_views(grid, pictures) < 0.05


def test_a_row_of_smaller_views_is_named():
    pictures = show_views(rows=(48, SIDE, SIDE))
    grid = view_grid.find_grid(pictures)
    assert grid.y.count == 2
    with pytest.warns(
        UserWarning, match=r"^2 rows x 3 columns of views, 3\d% .* 0\.8\d of a view above"
    ):
        assert 0.25 < share_of_events_outside_views(grid, pictures) < 0.4


def test_three_rows_of_unequal_views_are_found_by_their_seams():
    grid = view_grid.find_grid(show_views(rows=(40, SIDE, 44)))
    assert grid.positions == [(row, col) for row in (-1, 0, 1) for col in (-1, 0, 1)]
    assert np.abs(np.subtract(grid.centre_view_edges, (55.5, 39.5, 111.5, 95.5))).max() < 2


def test_rows_of_unequal_views_without_clear_seams_are_refused(monkeypatch):
    monkeypatch.setattr(view_grid, "SEAM_LIKENESS", 2.0)
    with pytest.raises(
        ValueError, match="two or more whole rows of views, of one size within 10 %"
    ):
        view_grid.find_grid(show_views(rows=(40, SIDE, 44)))


def match(off_px: float, found: int = 10) -> ViewMatches:
    """Return 10 places, `found` of which lie `off_px` off."""
    offset = np.where(np.arange(10)[:, None] < found, (off_px, 0.0), np.nan)
    return ViewMatches(np.zeros((10, 2)), np.zeros((10, 2)), offset, 8.0)


def test_a_view_off_in_windows_left_out_is_refused():
    scene, centre = scene_alignment.SceneTarget(error_px=1.5), {(0, 0): match(0.0)}
    for allowed in (match(1.4), match(1.68, found=3)):
        scene_alignment._check_held_out(centre | {(0, 1): allowed}, scene)
    with pytest.raises(ValueError, match=r"view \(0, 1\) is 1\.68 px off in windows left out"):
        scene_alignment._check_held_out(centre | {(0, 1): match(1.68, found=5)}, scene)


@pytest.mark.parametrize("exchanged", [(0, 1), (0, 0)])
def test_a_view_with_on_and_off_exchanged_is_named(exchanged):
    pictures = np.concatenate([show_views(), show_views(seeds=(5, 6))], axis=1)
    grid = view_grid.find_grid(pictures)
    scene_alignment._check_polarity(pictures, grid)
    y, x = (slice(SIDE * (at + 1), SIDE * (at + 2)) for at in exchanged)
    pictures[..., y, x] = pictures[:, ::-1, y, x].copy()
    with pytest.raises(ValueError, match=re.escape(f"those of view {exchanged} are exchanged;")):
        scene_alignment._check_polarity(pictures, grid)


def test_a_blocked_view_is_left_out():
    pictures = show_views(blocked=[(1, 1)])
    grid = view_grid.find_grid(pictures)
    with pytest.warns(UserWarning, match=r"^next to nothing is seen in view \(1, 1\), which is"):
        left = leave_out_blocked_views(grid, pictures)
    assert left.positions == [at for at in grid.positions if at != (1, 1)]


@pytest.mark.parametrize("blocked", [(), ((1, 1),)])
def test_margins_of_the_sensor_are_no_blocked_views(blocked):
    pictures = show_views(blocked=blocked)
    grid = view_grid.find_grid(pictures)
    wide = np.pad(pictures, ((0, 0), (0, 0), (0, 0), (SIDE, SIDE)), constant_values=100)
    widened = replace(grid, x=replace(grid.x, count=5))
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        found = leave_out_blocked_views(widened, wide)
    moved = replace(grid.x, start=grid.x.start + grid.x.pitch)
    assert found == replace(grid, x=moved, left_out=blocked) and len(told) == len(blocked)


def test_a_blocked_centre_view_is_refused():
    pictures = show_views(blocked=[(0, 0)])
    grid = view_grid.find_grid(pictures)
    with pytest.raises(ValueError, match=r"nothing is seen in \(0, 0\) of 9 views, which may be"):
        leave_out_blocked_views(grid, pictures)


def test_the_overlay_has_room_for_a_view_left_out(tmp_path):
    views = simulated_recording.kaleidoscope_views(
        list(layout(4)), model=(40, 40), sensor=(120, 160), tile_px=40, key=1
    )
    seen, shares = views.select(views.positions[:3]), dict.fromkeys(views.positions, 1.0)
    draw_views_over_centre(np.ones((120, 160)), seen, shares, tmp_path / "overlay.png")
    assert (tmp_path / "overlay.png").stat().st_size
