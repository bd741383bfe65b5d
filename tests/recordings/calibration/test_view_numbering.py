"""The position of each view follows from where its board lies, whatever the shape of the grid."""

import math

import numpy as np
import pytest

from src.recordings.calibration import view_alignment, view_field
from src.recordings.calibration.boards import Checkerboard
from src.recordings.calibration.view_grid import ViewAxis, ViewGrid
from src.recordings.calibration.view_numbering import assign_view_positions
from src.recordings.views import View, Views, share_on_sensor
from tests.recordings import pictures

BOARD = (255 * pictures.checkerboard(5, 7)).astype(np.uint8)
HALF_BOARD = np.array([[-48, -60], [48, -60], [48, 60], [-48, 60]])


def grid_positions(rows: int, cols: int) -> list[tuple[int, int]]:
    """Return the positions that target=scene gives to whole views."""
    return ViewGrid(ViewAxis(0, 1, cols, 1), ViewAxis(0, 1, rows, 1)).positions


def show_boards(rows: int, cols: int, width: int = 240, shift_px: int = 0) -> np.ndarray:
    """Return (240 rows, width cols): mirrored tiles with a board in the middle, each board up to
    `shift_px` off."""
    rng, tile = np.random.default_rng(1), np.full((240, width), 230, np.uint8)
    tile[:, (width - 240) // 2 :][:, :240] = BOARD
    seen = np.zeros((240 * rows, width * cols), np.uint8)
    for row, col in grid_positions(rows, cols):
        y, x = (240 * (row + (rows - 1) // 2), width * (col + (cols - 1) // 2))
        view = tile[:: -1 if row % 2 else 1, :: -1 if col % 2 else 1]
        shift = rng.integers(-shift_px, shift_px + 1, 2)
        seen[y : y + 240, x : x + width] = np.roll(view, shift, (0, 1))
    return seen


def align(picture: np.ndarray, model=(208, 368)) -> Views:
    found = view_alignment.find_target_in_views(picture, Checkerboard(5, 7))
    return view_alignment.fit_homographies(found, sensor=picture.shape, model=model).views


@pytest.mark.parametrize(
    "rows, cols, width, shift_px", [(3, 3, 426, 0), (2, 3, 240, 4), (2, 2, 240, 4), (2, 2, 426, 0)]
)
def test_boards_in_a_grid_of_any_shape(rows, cols, width, shift_px):
    there = align(show_boards(rows, cols, width, shift_px))
    assert there.positions == grid_positions(rows, cols)
    for view in there.views:
        assert there.mirrored_xy(view) == (view.position[1] % 2 == 1, view.position[0] % 2 == 1)
    left, top, right, bottom = there.field
    assert (right - left) / (bottom - top) == pytest.approx(368 / 208)
    x, y = ((count - 1) // 2 * size for count, size in ((cols, width), (rows, 240)))
    inside = left - x, top - y, x + width - right, y + 240 - bottom
    assert min(inside) > 5 and min(inside[0], inside[1]) < 0.05 * width


def show_targets(rows, cols, tile, sensor, turn_degrees=0.0, off=(0.0, 0.0), missing=()):
    """Return the corners of targets, and their positions: `off` (x, y) the middle of views, which
    lie in tiles (height, width) about the middle of the sensor, turned and up to 4 px off."""
    rng, angle = np.random.default_rng(0), math.radians(turn_degrees)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    positions = [at for at in grid_positions(rows, cols) if at not in missing]
    targets = []
    for row, col in positions:
        x = (col + (cols - 1) // 2 - (cols - 1) / 2) * tile[1] + off[0] * (-1) ** (col % 2)
        y = (row + (rows - 1) // 2 - (rows - 1) / 2) * tile[0] + off[1] * (-1) ** (row % 2)
        middle = turn @ (x, y) + (np.array(sensor[::-1]) - 1) / 2
        targets.append(middle + rng.uniform(-4, 4, 2) + HALF_BOARD)
    return targets, positions


@pytest.mark.parametrize("off", [(0, 0), (20, 15), (-20, -15)])
@pytest.mark.parametrize(
    "rows, cols, width",
    [(3, 3, 240), (3, 3, 426), (2, 2, 240), (2, 3, 300), (4, 2, 240), (5, 5, 240)],
)
def test_targets_off_the_middle_of_their_views(rows, cols, width, off):
    sensor = (240 * rows, width * cols)
    targets, positions = show_targets(rows, cols, (240, width), sensor, off=off)
    assert assign_view_positions(targets, sensor) == positions


@pytest.mark.parametrize("degrees", [-20, 10, 20])
@pytest.mark.parametrize("tile", [(230, 230), (240, 426)])
def test_views_turned_on_the_sensor(tile, degrees):
    targets, positions = show_targets(3, 3, tile, (720, 1280), degrees)
    assert assign_view_positions(targets, (720, 1280)) == positions


ROW, COL = [(1, col) for col in (-1, 0, 1)], [(row, -1) for row in (-1, 0, 1)]


@pytest.mark.parametrize(
    "missing", [[(-1, 0)], [(0, 1), (1, 0), (1, 1)], ROW, COL, [*ROW, (-1, 1)]]
)
@pytest.mark.parametrize("tile", [(230, 230), (240, 426)])
def test_views_that_do_not_show_the_target_keep_the_numbers_of_others(tile, missing):
    targets, positions = show_targets(3, 3, tile, (720, 1280), missing=missing)
    assert assign_view_positions(targets, (720, 1280)) == positions


@pytest.mark.parametrize("missing", [-2, 1, 2])
def test_a_row_of_views_with_one_that_does_not_show_the_target(missing):
    targets, positions = show_targets(1, 5, (240, 240), (300, 1200), missing=[(0, missing)])
    assert assign_view_positions(targets, (300, 1200)) == positions


def test_two_targets_at_one_position_are_refused(monkeypatch):
    monkeypatch.setattr(
        view_alignment, "assign_view_positions", lambda targets, _: [(0, 0)] * len(targets)
    )
    message = r"view \(0, 0\) must show one target, got two at pixels \(x, y\) \(\d+, \d+\) and"
    with pytest.raises(ValueError, match=message):
        view_alignment.find_target_in_views(show_boards(1, 2), Checkerboard(5, 7))


def test_a_target_found_twice_counts_once():
    whole = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2)
    part = np.where(np.arange(35)[:, None] < 20, whole, np.nan)
    for one, other in ((whole, part), (part, whole)):
        assert view_alignment._choose_fuller((0, 0), one, other) is whole


def test_a_larger_centre_view_has_the_field_that_all_views_show():
    scene = (255 * pictures.checkerboard(5, 7, pitch=11)).astype(np.uint8)
    whole = np.arange(240)
    lines = np.concatenate([whole[:170][::-1], whole, whole[70:][::-1]])
    picture = scene[np.ix_(lines, lines)]
    with pytest.warns(UserWarning, match="of the centre one only: the field is 4[45]% of it"):
        there = align(picture, model=(80, 88))
    assert there.positions == grid_positions(3, 3)
    assert min(share_on_sensor(v, there.field, there.sensor) for v in there.views) == 1
    left, top, right, bottom = np.array(there.field) - 170 + 0.5  # of the centre view
    assert (right - left) / (bottom - top) == pytest.approx(88 / 80)
    assert 69 < left < 75 and 165 < right < 171


def test_a_view_with_less_than_the_middle_of_the_centre_one_is_refused():
    far = View((0, 1), np.array([[1.0, 0, -90], [0, 1, 0], [0, 0, 1]]))
    with pytest.raises(ValueError, match=r"view \(0, 1\) has 11% of the centre one on the sensor"):
        view_field.shrink_field((0, 0, 100, 100), [View((0, 0), np.eye(3)), far], (101, 101))
