"""A figure is a file that opens, in a folder that is made, and nothing is left half written."""

import pytest
from matplotlib.figure import Figure
from PIL import Image

from src.figures.plots import save_figure


def test_a_figure_is_written_whole(tmp_path):
    path = save_figure(Figure(figsize=(2, 1)), tmp_path / "new" / "a.png")
    with Image.open(path) as picture:
        assert picture.size == (300, 150)
    assert [file.name for file in path.parent.iterdir()] == ["a.png"]


def test_a_figure_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(ValueError, match="nonsense"):
        save_figure(Figure(), tmp_path / "a.nonsense")
    assert not list(tmp_path.iterdir())
