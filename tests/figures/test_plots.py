"""Grids and curves: files that open, contents that are there, nothing half written."""

import numpy as np
import pytest
from PIL import Image

from src.figures.plots import curves, grid


def read(path) -> np.ndarray:
    with Image.open(path) as image:
        return np.array(image.convert("RGB"))


def test_a_grid_shows_grey_and_colour_and_rows_of_other_lengths(tmp_path):
    red = np.tile(np.array([1.0, 0.0, 0.0]), (20, 30, 1))
    grey = np.full((20, 30), 0.5)
    shown = read(grid(tmp_path / "new" / "grid.png", {"a": {"1": grey, "2": red}, "b": {"1": red}}))
    top, bottom = np.array_split(shown, 2)
    assert (top == (255, 0, 0)).all(-1).mean() > 0.2 and (top == 128).all(-1).mean() > 0.2
    left, right = np.array_split(bottom, 2, axis=1)
    assert (left == (255, 0, 0)).all(-1).mean() > 0.5 and (right == 255).all(-1).mean() > 0.9


def test_curves_draw_lines_and_spread(tmp_path):
    x = np.array([1.0, 10.0, 100.0])
    lines = {"a": (x, x), "b": (x, 2 * x, 0.2 * x)}
    path = curves(tmp_path / "c.png", lines, xlabel="x (px)", ylabel="y (s)", log="xy")
    colours = {tuple(colour) for colour in read(path).reshape(-1, 3)}
    assert {(31, 119, 180), (255, 127, 14)} <= colours
    assert [file.name for file in tmp_path.iterdir()] == ["c.png"]


def test_a_grid_of_nothing_is_refused(tmp_path):
    with pytest.raises(ValueError, match="at least 1 picture"):
        grid(tmp_path / "grid.png", {})
