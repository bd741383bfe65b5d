"""The metrics of a clip: what each is called, to how many digits it is said, which way is better.

Tables, figures and model cards take their columns from here, in this order; how a metric is
computed stands in scores.py.  This file imports nothing, so that a report needs no PyTorch.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """`name`: its key in results.json and clips.csv.  `better`: 1 where more is better, -1 where
    less is.
    """

    name: str
    heading: str
    digits: int
    better: int

    @property
    def arrow(self) -> str:
        """The direction that is better, as the heads of tables show it."""
        return "↑" if self.better > 0 else "↓"

    def written(self, value: float | None) -> str:
        """Return a value as people read it; a dash for none."""
        return "-" if value is None else f"{value:.{self.digits}f}"


METRICS = (
    Metric("lpips", "LPIPS", 3, -1),
    Metric("ssim", "SSIM", 3, 1),
    Metric("psnr", "PSNR", 2, 1),
    Metric("psnr_aligned", "aligned PSNR", 2, 1),
    Metric("wobble", "wobble px", 2, -1),
)
NAMES = tuple(metric.name for metric in METRICS)
