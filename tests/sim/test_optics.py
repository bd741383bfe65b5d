"""Arrangement of views."""

import inspect

import pytest

from src.sim.optics import Optics, layout, view_id


def test_layouts():
    assert layout(1) == ((0, 0),)
    assert layout(9)[0] == (-1, -1) and layout(9)[4] == (0, 0) and layout(9)[8] == (1, 1)
    assert layout(4) == ((0, 0), (0, 1), (1, 0), (1, 1))
    assert len(set(layout(25))) == 25 and len(layout(5)) == 5


def test_centre_and_ids():
    assert view_id((0, 0)) == 144
    for views in (1, 2, 3, 4, 5, 9, 25):
        optics = Optics(views)
        assert optics.positions[optics.centre] == (0, 0)
        assert len(set(optics.random_key_ids)) == views


@pytest.mark.parametrize("views", [0, -1, 6, 7, 10, 400])
def test_unknown_layout_names_the_key(views):
    with pytest.raises(ValueError, match="optics.views"):
        Optics(views)


@pytest.mark.parametrize("views", ["9", 2.5, 7, None])
def test_a_layout_is_of_a_whole_number(views):
    with pytest.raises(ValueError, match=r"^views must be 1, 2, 3, 5 or a square .*, got "):
        inspect.unwrap(layout)(views)  # without the type checks of tests


@pytest.mark.parametrize(
    ("positions", "message"),
    [
        ([(0, 0), (0, 0)], r"be 2 different \(row, col\)"),
        ([(0, 0), (0, 9)], "lie in -8..8"),
        ([1, 2, 3], r"be a list of \(row, col\), whole numbers, got \[1, 2, 3\]"),
        (["a", "b"], r"be a list of \(row, col\)"),
        ([(0, 0), (0, "1")], r"be a list of \(row, col\)"),
        ([(0, 0), (0, float("inf"))], r"be a list of \(row, col\)"),
        ([(0, 0), (0, 1, 2)], r"be a list of \(row, col\)"),
        ([(0, 0), (False, True)], r"be a list of \(row, col\)"),
    ],
)
def test_wrong_positions(positions, message):
    with pytest.raises(ValueError, match=f"optics.positions must {message}"):
        Optics(2, positions)
