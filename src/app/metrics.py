"""The metrics of validation and test from a configuration."""

from omegaconf import DictConfig
from torchmetrics import Metric

from src.app.instantiate import build_part
from src.metrics.video_metrics import VideoMetrics

SHIPPED_METRIC_KEYS = ("lpips", "resolution_scale", "jitter_reduction")


def build_metrics(cfg: DictConfig) -> VideoMetrics:
    """Return the metrics of validation and test: those of the project, LPIPS if `metrics.lpips` is
    given, and every further part of `metrics`, the user's own; ValueError for what is none.
    """
    lpips = build_part(cfg, "metrics.lpips") if cfg.metrics.lpips else None
    names = [name for name in cfg.metrics if name not in SHIPPED_METRIC_KEYS and cfg.metrics[name]]
    own = {str(name): _build_own_metric(cfg, str(name)) for name in names}
    return VideoMetrics(lpips, cfg.metrics.resolution_scale, own, cfg.metrics.jitter_reduction)


def _build_own_metric(cfg: DictConfig, name: str) -> Metric:
    metric = build_part(cfg, f"metrics.{name}")
    if not isinstance(metric, Metric):
        got = f"{type(metric).__module__}.{type(metric).__name__}"
        raise ValueError(f"metrics.{name}._target_ must be a torchmetrics.Metric, got {got}")
    return metric
