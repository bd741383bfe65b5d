"""Figures in one style, written whole or not at all."""

from pathlib import Path

from matplotlib.figure import Figure

from src.records.atomic import written

DPI = 150
MARKERS = "osD^vP*"


def save(figure: Figure, path: Path) -> Path:
    """Write `figure` under a temporary name, then rename; the folder is made."""
    with written(path) as partial:
        figure.savefig(partial, dpi=DPI, format=path.suffix[1:])
    return path
