"""Names in the chart of accuracy against time stand nearest to their own points."""

from matplotlib.figure import Figure
from matplotlib.text import Annotation

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
