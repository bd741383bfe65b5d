"""Figures in one style, written whole or not at all."""

from pathlib import Path

import matplotlib as mpl
from matplotlib.figure import Figure

from src.records.atomic import atomic_path

MARKERS = "osD^vP*"
mpl.rcParams |= {
    "figure.constrained_layout.use": True, "savefig.dpi": 150, "image.cmap": "gray",
    "axes.titlesize": 9, "legend.fontsize": 8,
}  # fmt: skip


def save_figure(figure: Figure, path: Path) -> Path:
    """Write `figure` under a temporary name, then rename; the folder is made."""
    with atomic_path(path) as partial:
        figure.savefig(partial, format=path.suffix[1:])
    return path
