"""Names in the chart of accuracy against time stand nearest to their own points."""

from dataclasses import replace

import pytest
from matplotlib.figure import Figure
from matplotlib.text import Annotation

from src.bench.speed import SpeedMeasurement
from src.bench.speed_accuracy import ClipScore
from src.figures import frontier
from src.figures.frontier import _box, _gap, _name_points


def test_names_of_points_side_by_side_are_nearest_to_their_own():
    figure = Figure(figsize=(14, 6))
    axes = figure.subplots(1, 2)[1]
    axes.set_xscale("log")
    axes.set(xlim=(0.08, 1050), ylim=(17.25, 20.9))
    spans = {  # least ms, ms, score; as measured
        "firenet plus": (11.9, 14.6, 17.80), "firenet": (12.0, 14.8, 17.72),
        "highpass": (0.2, 0.2, 17.93), "highpass median": (5.72, 7.2, 17.68),
        "e2vid plus": (10.7, 12.0, 17.58), "etnet": (27.8, 43.1, 17.50),
        "hypere2vid": (12.3, 15.2, 17.55), "firenet plus mambatm": (208, 354, 17.82),
    }  # fmt: skip
    figure.draw_without_rendering()
    _name_points(axes, spans)
    to_px = axes.transData.transform
    lines = {
        name: _box(to_px((least, score)), to_px((ms, score)))
        for name, (least, ms, score) in spans.items()
    }
    names = [text for text in axes.texts if isinstance(text, Annotation)]
    assert len(names) == len(spans)
    for text in names:
        box = text.get_window_extent()
        nearest = min(lines, key=lambda name: _gap(box, lines[name]))
        assert nearest == text.get_text()


@pytest.mark.parametrize("side", [64, 176])
def test_the_papers_time_is_drawn_at_its_own_size_and_clips_are_counted(
    tmp_path, monkeypatch, side
):
    drawn = []
    monkeypatch.setattr(frontier, "save_figure", lambda figure, path: drawn.append(figure) or path)
    speed = SpeedMeasurement("net", True, 9, side, "cpu", 1, "float32", ms=5.0)
    scores = [ClipScore("net", s, k, {"psnr_aligned": 20.0}) for s in "ab" for k in range(2)]
    frontier.draw_accuracy_against_time(tmp_path / "a.png", [speed], scores, side=side, title="t")
    (axes,) = drawn[0].axes
    written = " ".join(text.get_text() for text in axes.texts)
    assert ("the paper" in written) == (side == 176) and "600 frames" in written
    assert drawn[0].get_suptitle() == "t, 4 clips" and "aligned PSNR, dB" in axes.get_title()


def test_bars_are_the_error_of_the_difference_to_the_best(tmp_path, monkeypatch):
    psnr = {"best": [20, 30, 40], "less": [19, 28, 37], "none": [None, float("nan"), 5.0]}
    scores = [
        ClipScore(name, "weak", clip, {"psnr_aligned": value})
        for name, row in psnr.items()
        for clip, value in enumerate(row)
    ]
    (metric,) = (metric for metric in frontier.DRAWN if metric.name == "psnr_aligned")
    wanted = {"best": 0.0, "less": 1 / 3**0.5}
    assert frontier.compute_standard_errors(metric, scores) == pytest.approx(wanted)
    again = [
        replace(score, severity="strong") for score in scores
    ]  # the same scenes: no more clips
    assert frontier.compute_standard_errors(metric, scores + again) == pytest.approx(wanted)
    drawn = []
    monkeypatch.setattr(frontier, "save_figure", lambda figure, path: drawn.append(figure) or path)
    speeds = [SpeedMeasurement(n, True, 9, 64, "cpu", 1, "float32", ms=5.0) for n in psnr]
    frontier.draw_accuracy_against_time(tmp_path / "a", speeds, scores[:6], side=64, title="t")
    (bar,) = drawn[0].axes[0].collections
    assert bar.get_segments()[0][:, 1] == pytest.approx([28 - 1 / 3**0.5, 28 + 1 / 3**0.5])
    told = [text.get_text() for text in drawn[0].legends[0].get_texts()]
    assert "standard error of the difference to the best" in told


def test_a_name_does_not_cover_the_text_of_a_line():
    figure = Figure(figsize=(7, 6))
    axes = figure.subplots()
    axes.set(xlim=(0, 10), ylim=(0, 10))
    beside = axes.text(5.1, 5, "a long text", va="center")
    figure.draw_without_rendering()
    _name_points(axes, {"net": (5.0, 5.0, 5.0)})
    name = next(text for text in axes.texts if isinstance(text, Annotation))
    assert not name.get_window_extent().overlaps(beside.get_window_extent())
