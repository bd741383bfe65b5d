"""The metrics of a clip as tables, figures and model cards show them, in this order.

They are computed in video_metrics.py; this file imports nothing, so that a report needs no PyTorch.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class MetricColumn:
    """`name`: its key in results.json and clips.csv.  `better`: 1 where more is better, -1 where
    less is.
    """

    name: str
    heading: str
    digits: int
    better: int

    @property
    def arrow(self) -> str:
        return "↑" if self.better > 0 else "↓"

    def format_value(self, value: float | None) -> str:
        """Return a value as people read it; a dash for none."""
        return "-" if value is None else f"{value:.{self.digits}f}"


METRICS = (
    MetricColumn("lpips", "LPIPS", 3, -1),
    MetricColumn("ssim", "SSIM", 3, 1),
    MetricColumn("psnr", "PSNR", 2, 1),
    MetricColumn("psnr_aligned", "aligned PSNR", 2, 1),
    MetricColumn("temporal_jitter_px", "temporal jitter px", 2, -1),
)
NAMES = tuple(metric.name for metric in METRICS)
