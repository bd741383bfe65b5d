"""Figures in one style, written whole or not at all."""

import os
from pathlib import Path

from matplotlib.figure import Figure

DPI = 150
MARKERS = "osD^vP*"


def save(figure: Figure, path: Path) -> Path:
    """Write `figure` under a temporary name, then rename; the folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".partial-{path.name}")
    figure.savefig(partial, dpi=DPI)
    os.replace(partial, path)
    return path
