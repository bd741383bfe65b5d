"""A figure of learning curves, from the files that trainings write."""

import os

import pytest
from PIL import Image

from scripts import learning_curves
from scripts.learning_curves import draw_curves, read_curve


def test_the_newest_curve_is_drawn(tmp_path):
    for part, lines in enumerate(("0,0.7,\n", "0,0.7,\n1,0.5,17\n")):
        folder = tmp_path / "lf" / f"part{part}"
        folder.mkdir(parents=True)
        (folder / "curve.csv").write_text("hours,lpips,psnr_aligned\n" + lines)
        os.utime(folder / "curve.csv", (part, part))
    rows = read_curve(tmp_path / "lf")
    assert [row["hours"] for row in rows] == [0, 1] and rows[1]["psnr_aligned"] == 17
    path = draw_curves(tmp_path / "a.png", {"lf": rows, "none yet": read_curve(tmp_path / "no")})
    with Image.open(path) as picture:
        assert picture.size[0] > picture.size[1]


def test_folders_of_one_name_have_curves_of_their_own(tmp_path, monkeypatch):
    folders = [tmp_path / name for name in ("a/run", "b/run", "b/other")]
    for folder in folders:
        folder.mkdir(parents=True)
        (folder / "curve.csv").write_text("hours,lpips\n0,0.7\n")
    drawn = []
    monkeypatch.setattr(learning_curves, "draw_curves", lambda _, curves: drawn.append(curves))
    monkeypatch.setattr("sys.argv", ["learning_curves", *map(str, folders)])
    learning_curves.main()
    assert list(drawn[0]) == ["a/run", "b/run", "b/other"] and all(drawn[0].values())
    assert learning_curves.name_folders(folders[1:]) == ["run", "other"]


def test_a_panel_has_its_unit(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(learning_curves, "save_figure", lambda figure, _: drawn.append(figure))
    line = {"hours": 0.0, "lpips": 0.5, "psnr": 20.0, "psnr_aligned": 21.0}
    draw_curves(tmp_path / "a.png", {"a": [line]})
    titles = [axes.get_title() for axes in drawn[0].axes]
    assert titles == ["LPIPS ↓", "PSNR, dB ↑", "aligned PSNR, dB ↑"]


def test_without_a_line_nothing_is_drawn(tmp_path):
    with pytest.raises(ValueError, match="curves must have a line"):
        draw_curves(tmp_path / "a.png", {"none": []})
