"""A view of a lens array turned by 180 degrees: the colours of squares tell, or it is said."""

import warnings

import numpy as np
import pytest

from src.recordings.calibration import view_alignment
from src.recordings.calibration.boards import Charuco, Checkerboard, Circles
from tests.recordings import pictures

TURNED = (0, 1)


def show_boards(rows: int, cols: int) -> np.ndarray:
    """Return (480, 480): 2 x 2 views of a board, not mirrored, TURNED upside down."""
    board = (255 * pictures.checkerboard(rows, cols)).astype(np.uint8)
    return np.block([[board, board[::-1, ::-1]], [board, board]])


def find_turned(picture: np.ndarray, board: Checkerboard) -> list:
    found = view_alignment.find_target_in_views(picture, board, are_mirrored=False)
    sizes = {"sensor": picture.shape, "model": (88, 88)}
    views = view_alignment.fit_homographies(found, **sizes).views
    assert views.positions == [(0, 0), (0, 1), (1, 0), (1, 1)]
    return [view.position for view in views.views if views.mirrored_xy(view) == (True, True)]


@pytest.mark.parametrize("rows, cols", [(5, 6), (6, 5), (4, 7)])
@pytest.mark.parametrize("is_negative", [False, True])
def test_one_odd_and_one_even_side_tell_a_turned_view(rows, cols, is_negative):
    picture = show_boards(rows, cols)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_turned(255 - picture if is_negative else picture, Checkerboard(rows, cols)) == [
            TURNED
        ]


@pytest.mark.parametrize("rows, cols", [(5, 7), (4, 6), (5, 5)])
def test_of_other_boards_views_are_said_to_be_taken_as_upright(rows, cols):
    with pytest.warns(UserWarning, match="^views are taken as upright, .* target=charuco or"):
        assert find_turned(show_boards(rows, cols), Checkerboard(rows, cols)) == []


@pytest.mark.parametrize(
    "target, are_mirrored, is_said",
    [(Circles(), False, True), (Checkerboard(5, 7), True, False), (Charuco(), False, False)],
)
def test_a_target_without_a_turn_is_said_of_lens_arrays_only(target, are_mirrored, is_said):
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        view_alignment.find_target_in_views(np.zeros((90, 120), np.uint8), target, are_mirrored)
    assert any("taken as upright" in str(one.message) for one in said) == is_said


def test_a_view_that_shows_a_part_of_the_board_is_warned_of():
    picture, board, sizes = show_boards(5, 6), Checkerboard(5, 6), {"model": (88, 88)}
    found = dict(view_alignment.find_target_in_views(picture, board, are_mirrored=False))
    sizes |= {"sensor": picture.shape}
    view_alignment.fit_homographies(found, **sizes)
    left = found[1, 1].copy()
    left[left[:, 0] > np.median(left[:, 0])] = np.nan
    with pytest.warns(UserWarning, match=r"^points span little .* height: view \(1, 1\) \d\d%; be"):
        view_alignment.fit_homographies(found | {(1, 1): left}, **sizes)
