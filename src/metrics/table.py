"""The metrics of a clip as tables, figures and model cards show them, in this order.

They are computed in video_metrics.py; this file needs no PyTorch, so that a report does not.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import fmean

ARROWS = {1: " ↑", -1: " ↓", 0: ""}  # towards better values


@dataclass(frozen=True)
class Column:
    """`name`: its key in results.json and clips.csv.  `better`: 1 where more is better, -1 where
    less is, 0 where neither; `group` stands above the columns that have it, such as the source of
    published numbers; figures add the `unit` to the heading.  A metric that a config adds has its
    key there as name and heading.
    """

    name: str
    heading: str
    digits: int = 0
    better: int = 0
    group: str = ""
    unit: str = ""

    @property
    def title(self) -> str:
        """The heading with an arrow towards better values."""
        return self.heading + ARROWS[self.better]

    @property
    def heading_with_unit(self) -> str:
        """The heading, and the unit where it has none."""
        return f"{self.heading}, {self.unit}" if self.unit else self.heading

    def format_value(self, value: float | None) -> str:
        """Return a value as people read it; a dash for none."""
        return "-" if value is None else f"{value:.{self.digits}f}"


METRICS = (
    Column("lpips", "LPIPS", 3, -1),
    Column("ssim", "SSIM", 3, 1),
    Column("psnr", "PSNR", 2, 1, unit="dB"),
    Column("psnr_aligned", "aligned PSNR", 2, 1, unit="dB"),
    Column("temporal_jitter_px", "temporal jitter px", 2, -1),
)
NAMES = tuple(metric.name for metric in METRICS)


def mean_score(values: Iterable[float | None]) -> float | None:
    """Return the mean over the clips that have a score, None where none has; NaN where one is."""
    scored = [value for value in values if value is not None]
    return fmean(scored) if scored else None
